"""Machines: rigid links on joints, read from URDF or MJCF, and their sweeps along joint paths."""

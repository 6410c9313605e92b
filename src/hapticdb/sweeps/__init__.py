"""Sweeps: whether a part comes out along a path, what it hits, and its clearance."""

"""Resident cells of an environment, and frames on these cells alone."""

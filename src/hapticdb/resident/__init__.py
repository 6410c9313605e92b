"""Resident cells of an environment, and frames that read only these cells."""

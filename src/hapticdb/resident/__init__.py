"""Cells of an environment in memory, and frames that read nothing else."""

"""Distributed work on a dask.distributed scheduler, and workers' access to an environment."""

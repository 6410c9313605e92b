"""Work by a scheduler of dask.distributed: its workers, and where they find an environment."""

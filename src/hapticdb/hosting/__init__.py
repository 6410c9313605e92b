"""Many hands in few processes, which share one table of cells."""

"""Batches: one tool at many poses, against cells in memory, with all processors."""

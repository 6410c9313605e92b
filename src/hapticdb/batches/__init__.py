"""Batches: one tool at many poses, against cells in memory, in parallel."""

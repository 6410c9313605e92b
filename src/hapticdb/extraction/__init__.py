"""Extraction: searches for a path on which a part comes out, and says what blocks it."""

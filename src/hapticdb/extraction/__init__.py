"""Extraction: proved removal paths of parts, and the objects in the way."""

"""Reads from standbys: which host, how far behind, and how old an answer may be."""

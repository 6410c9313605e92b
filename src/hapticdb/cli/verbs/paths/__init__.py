"""Verbs about paths of parts."""

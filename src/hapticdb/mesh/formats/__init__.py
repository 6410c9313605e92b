"""Readers, one for each format: from a file to shapes and placements, unchecked."""

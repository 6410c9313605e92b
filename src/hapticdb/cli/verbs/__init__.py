"""The commands, one module for a few."""

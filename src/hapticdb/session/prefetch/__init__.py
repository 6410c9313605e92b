"""Cells that tools are heading for, fetched before a frame needs them."""

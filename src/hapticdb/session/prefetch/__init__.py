"""Cells ahead of the tools, fetched before a frame needs them."""

"""Plots of measured cells as SVG files."""

"""Narrow phase: distances, sweeps, clashes, separation and penetration of triangles, proved."""

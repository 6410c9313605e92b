"""Clashes: near, touching, overlapping and nested pairs of objects, and decisions about them."""

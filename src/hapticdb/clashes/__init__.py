"""Clashes: pairs of objects that are near, touch, overlap, or lie one in the other."""

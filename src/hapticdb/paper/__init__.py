"""Strategies of Kriegel et al. (the paper, sections 4 and 5): grouping, and its cost model."""

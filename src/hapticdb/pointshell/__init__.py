"""PointShells: points sampled on a surface, their normals, and how well they cover it."""

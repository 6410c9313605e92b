"""PointShells: points sampled on a surface, and their normals."""

"""Import: reads, voxelizes and writes files; moves and replaces objects."""

"""Parts to rows: files read, voxelized and written, objects placed and replaced."""

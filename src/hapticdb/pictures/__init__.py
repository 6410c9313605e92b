"""Pictures: splatted voxels, the demo's picture, the picture of a sweep."""

"""Whether a part comes out along a path: what it hits, and how much clearance it keeps."""

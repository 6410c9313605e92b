"""The haptic query: a PointShell at a pose in, a wrench with hits and objects out."""

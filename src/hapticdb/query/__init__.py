"""The haptic query: contact force of a PointShell at a pose, with hits and objects."""

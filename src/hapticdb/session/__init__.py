"""A hand in an environment, felt in real time: its processes, slots and reports."""

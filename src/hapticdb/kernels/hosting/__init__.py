"""The loop of a worker that runs many sessions, as one kernel."""

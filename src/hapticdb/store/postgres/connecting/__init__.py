"""A connection to a server: how it is made, waits, comes back after a loss, and reports errors."""

"""The tables of an environment in a file: read, written, their statistics."""

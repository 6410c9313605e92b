"""The tables of an environment on a server: read, written, loaded, their statistics."""

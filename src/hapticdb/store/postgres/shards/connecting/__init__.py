"""Connections to the servers of one environment: where they are, asked at once, away."""

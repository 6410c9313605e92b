"""Borders between shards, moved while others read and write."""

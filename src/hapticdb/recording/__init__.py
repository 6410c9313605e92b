"""Recorded sessions: file format, writer and reader."""

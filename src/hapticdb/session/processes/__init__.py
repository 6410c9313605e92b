"""Processes of a session, and the messages between them."""

"""The real-time engine: frames that never wait on the database."""

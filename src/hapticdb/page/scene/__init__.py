"""The scene of the page: nodes, level of detail, picking, and updates from the database."""

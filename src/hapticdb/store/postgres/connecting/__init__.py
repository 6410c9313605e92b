"""A connection to a server: made, waited for, made again after a loss; its errors by name."""

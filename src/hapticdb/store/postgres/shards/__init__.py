"""An environment whose rows are on several PostgreSQL servers."""

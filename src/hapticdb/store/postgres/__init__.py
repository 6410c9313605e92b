"""PostgreSQL through psycopg 3: the engine for many people at once. Needs the extra `postgres`."""

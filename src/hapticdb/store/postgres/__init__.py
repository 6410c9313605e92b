"""PostgreSQL through psycopg 3: the engine for many clients. Needs the extra `postgres`."""

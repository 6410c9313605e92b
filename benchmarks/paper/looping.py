"""The paper's own form of a scan: a loop inside the server that reads one range at a time.

The paper ran its loop in PL/SQL, so its figures count descents of the index and no round trips.
Here the loop is PL/pgSQL, and gets the same ranges as the single statement.
"""

from typing import Any, cast

import numpy as np

from hapticdb.store.base import NO_OCCUPANCY, NO_ROWS, Keys, Layout, Rows, Store
from hapticdb.store.postgres.connecting import failures, wire
from hapticdb.store.postgres.store import PostgresStore

NAME = "pg_temp.scan_ranges"
# a temporary function: the environment itself stays as it is
MAKE: dict[Layout, str] = {
    "voxel": f"""
CREATE OR REPLACE FUNCTION {NAME}(lows bigint[], highs bigint[],
                                  OUT keys bigint[], OUT ids bigint[])
LANGUAGE plpgsql STABLE AS $$
DECLARE found_keys bigint[]; found_ids bigint[];
BEGIN
  FOR n IN 1 .. cardinality(lows) LOOP
    SELECT array_agg(z_val), array_agg(id) INTO found_keys, found_ids
      FROM voxel WHERE z_val BETWEEN lows[n] AND highs[n];
    IF found_keys IS NOT NULL THEN
      keys := keys || found_keys;
      ids := ids || found_ids;
    END IF;
  END LOOP;
END $$""",
    "brick": f"""
CREATE OR REPLACE FUNCTION {NAME}(lows bigint[], highs bigint[],
                                  OUT keys bigint[], OUT ids bigint[], OUT bits bytea)
LANGUAGE plpgsql STABLE AS $$
DECLARE found_keys bigint[]; found_ids bigint[]; found_bits bytea;
BEGIN
  bits := '';
  FOR n IN 1 .. cardinality(lows) LOOP
    SELECT array_agg(z_val), array_agg(id), string_agg(occupancy, '')
      INTO found_keys, found_ids, found_bits
      FROM brick WHERE z_val BETWEEN lows[n] AND highs[n];
    IF found_keys IS NOT NULL THEN
      keys := keys || found_keys;
      ids := ids || found_ids;
      bits := bits || found_bits;
    END IF;
  END LOOP;
END $$""",
}


class LoopInServer:
    """A PostgreSQL store whose `scan` loops over its ranges inside the server."""

    def __init__(self, store: PostgresStore) -> None:
        self._store = store
        self._connection = store.connection
        with failures.named_errors(self._connection.shown):
            self._connection.command(MAKE[store.layout])

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - all else is the store's own
        return getattr(self._store, name)

    def scan(self, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows with a key in any of the closed ranges, ascending and disjoint; no distances."""
        assert not distances
        if not lows.size:
            return NO_ROWS
        columns = "keys, ids, bits" if self._store.layout == "brick" else "keys, ids"
        text = f"SELECT {columns} FROM {NAME}($1, $2)"
        found = self._connection.fetch(text, wire.int8s(lows), wire.int8s(highs))
        if found[0] is None:
            return NO_ROWS
        occupancy = (
            np.frombuffer(found[2] or b"", np.uint8)
            if self._store.layout == "brick"
            else NO_OCCUPANCY
        )
        return Rows(wire.read_int8s(found[0]), wire.read_int8s(found[1]), occupancy)


def looping(store: PostgresStore) -> Store:
    """The same store, but its `scan` loops over the ranges inside the server, one at a time."""
    return cast("Store", LoopInServer(store))


def server_cache(store: PostgresStore) -> int:
    """Bytes of pages that the server keeps in memory, for all its connections."""
    asked = "SELECT pg_size_bytes(current_setting('shared_buffers'))"
    return int(store.connection.rows(asked)[0][0])

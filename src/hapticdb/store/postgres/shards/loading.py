"""The indexes of rows on shards, for loading: dropped, made and cleaned up on all at once."""

from hapticdb.store.base import Layout
from hapticdb.store.postgres.shards.connecting.links import ShardConnection, Shards
from hapticdb.store.postgres.shards.schemas import KEY
from hapticdb.store.postgres.tables.loading import IndexesHere


class IndexesOnShards:
    """Indexes of the rows on all shards."""

    def __init__(self, shards: Shards, layout: Layout) -> None:
        self._shards = shards
        self._layout: Layout = layout

    def _of(self, shard: ShardConnection) -> IndexesHere:
        return IndexesHere(shard, self._layout, KEY)

    def are_there(self) -> bool:
        """Whether no index is missing on any shard."""
        return all(self._shards.each(lambda _, shard: self._of(shard).are_there()))

    def have_no_rows(self) -> bool:
        """Whether the tables of all shards are empty."""
        return all(self._shards.each(lambda _, shard: self._of(shard).have_no_rows()))

    def drop(self) -> None:
        """Drop the indexes of shards where nobody is reading."""
        self._shards.each(lambda _, shard: self._of(shard).drop())

    def make(self) -> None:
        """Make the missing indexes, on all shards at once."""

        def make(_: int, shard: ShardConnection) -> None:
            with shard.without_limit("statement_timeout", "lock_timeout"):
                self._of(shard).make()

        self._shards.each(make)

    def vacuum(self) -> None:
        """Let frames read the index only, on all shards at once."""

        def vacuum(_: int, shard: ShardConnection) -> None:
            with shard.without_limit("statement_timeout", "lock_timeout"):
                self._of(shard).vacuum()

        self._shards.each(vacuum)

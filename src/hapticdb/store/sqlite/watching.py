"""How a reader of a file learns that others have committed."""

from hapticdb.store.sqlite.connection import FileConnection


class SQLiteWatch:
    """What one connection has noticed of the commits of others."""

    def __init__(self, connection: FileConnection) -> None:
        self._connection = connection
        self._noticed = -1

    def watch(self) -> None:
        """Begin to notice commits from now on; may be called again."""
        self.has_changed()

    def has_changed(self) -> bool:
        """Whether another connection has committed since `watch` or the last call.

        By the pragma, which looks at the file's log: the binding's own `data_version` says what the
        last read has seen. Of an immutable opening by its stamp, and then for good. Raises
        ConnectionLostError when the path leads to another file than the one that was opened.
        """
        self._connection.check_outside()
        if self._connection.file.stamp is not None:
            self._connection.check_thread()
            return self._connection.file.has_new_stamp()
        self._connection.file.check()
        before = self._noticed
        self._noticed = self._connection.fetch("PRAGMA data_version")[0][0]
        return self._noticed != before

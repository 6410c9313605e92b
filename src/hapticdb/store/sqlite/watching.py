"""How a reader of a file learns that others have committed."""

from hapticdb.store.sqlite.connection import FileConnection


class SQLiteWatch:
    """Commits of others that one connection has noticed."""

    def __init__(self, connection: FileConnection) -> None:
        self._connection = connection
        self._noticed = -1

    def watch(self) -> None:
        """Begin to notice commits from now on; may be called again."""
        self.has_changed()

    def has_changed(self) -> bool:
        """Whether another connection has committed since `watch` or the last call.

        The pragma looks at the file's log; apsw's own `data_version` only says what the last read
        has seen. A file that was opened as immutable is judged by its stamp, and once changed, it
        stays so. Raises ConnectionLostError when the path leads to another file than before.
        """
        self._connection.check_outside()
        if self._connection.file.stamp is not None:
            self._connection.check_thread()
            return self._connection.file.has_new_stamp()
        self._connection.file.check()
        before = self._noticed
        self._noticed = self._connection.fetch("PRAGMA data_version")[0][0]
        return self._noticed != before

"""Where the shards of an environment are: what libpq connects to, and private servers of our own.

A shard's address comes from the coordinator's catalogue, which others may write. So no password
that a user gave for the coordinator goes to a shard: the passwords of shards are in ``~/.pgpass``,
which has one for each host.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from hapticdb.errors import DatabaseError, UsageError
from hapticdb.store.postgres.address import Address, servers_of
from hapticdb.store.postgres.private_server import shared_server
from hapticdb.store.postgres.server_binaries import fitting
from hapticdb.store.postgres.standby.aiming import wanted_server

REPLACED = {"host", "hostaddr", "port", "target_session_attrs", "load_balance_hosts"}
"""Parameters of the coordinator's address, which lead to no shard."""
SECRETS = {
    "password",
    "scram_client_key",
    "scram_server_key",
    "oauth_client_secret",
    "gssdelegation",
}
"""Parameters that would show or lend the user's right to another server."""
WANTED = {
    "primary": "primary",
    "read-write": "primary",
    "prefer-standby": "prefer-standby",
    "standby": "prefer-standby",
    "read-only": "prefer-standby",
}
"""Which server of a shard is read, by ``target_session_attrs`` of the coordinator's address."""
STARTS = 8
"""Private servers that start at the same time."""


def shard_conninfo(address: Address, coordinator: str, host: str) -> str:
    """URL of a shard's database with the coordinator's database, user and other settings.

    Parameters
    ----------
    address : Address
        The environment's, for messages.
    coordinator : str
        URL that libpq connects to for the coordinator.
    host : str
        The shard, as `Address.shards` and the catalogue have it; with standbys several servers.

    Raises
    ------
    UsageError
        `host` is no address of a server.

    Notes
    -----
    The empty ``password=`` and ``hostaddr=`` keep libpq from taking the coordinator's out of
    PGPASSWORD, PGHOSTADDR or a service; it still looks into the file of passwords.

    A shard without standbys is taken as it is. Of several servers the one is taken that the
    coordinator's ``target_session_attrs`` wants, where a shard may lack what that one names.
    """
    servers = servers_of(host)
    if not servers:
        raise UsageError(
            f"{address.shown}: {host!r} is no address of a shard: write a name, name:port, "
            "[IPv6 address]:port, or the folder of a socket; its standbys behind it, with | between"
        )
    parts = urlsplit(coordinator)
    user = parts.netloc.rpartition("@")[0].partition(":")[0]
    pairs = [
        pair
        for pair in parts.query.split("&")
        if pair and unquote(pair.partition("=")[0]) not in REPLACED | SECRETS
    ]
    wanted = WANTED.get(wanted_server(coordinator), "any") if len(servers) > 1 else "any"
    pairs += [f"host={','.join(quote(name, safe='/') for name, _ in servers)}"]
    pairs += [f"port={','.join(str(port) for _, port in servers)}"]
    pairs += ["hostaddr=", "password=", f"target_session_attrs={wanted}"]
    login = f"{user}@" if user else ""
    return f"{parts.scheme}://{login}{parts.path or '/'}?{'&'.join(pairs)}"


def private_shards(folder: Path, count: int, *, making: bool, database: str) -> list[str]:
    """Start the private servers in ``shards/1`` to ``shards/COUNT`` of a coordinator's folder.

    They run PostgreSQL of the coordinator's major version. The end of the process releases them.

    Parameters
    ----------
    folder : Path
        Folder of the coordinator, which is a `PrivateServer`'s.
    count : int
        Number of shards.
    making : bool
        Make missing servers and the database.
    database : str
        Name of the database on each of them.

    Returns
    -------
    list of str
        URLs of the databases for libpq, in the order of the shards.

    Raises
    ------
    DatabaseError
        The folder of a shard is missing, and `making` is false; or a server cannot be set up, or
        does not start.
    """
    folder = folder.expanduser().resolve()
    places = [folder / "shards" / str(n) for n in range(1, count + 1)]
    for number, place in enumerate(places, 1):
        if not making and not (place / "data").exists():
            raise DatabaseError(
                f"shard {number} is missing: {place} holds no server; put it back from a copy"
            )
    binaries = fitting(folder / "data", None)
    for place in [folder / "shards", *places]:
        _make_like(folder, place)

    def started(place: Path) -> str:
        server = shared_server(place, binaries)
        server.start()
        if making:
            server.create_database(database)
        return server.conninfo(database)

    with ThreadPoolExecutor(min(count, STARTS), "hapticdb-shards") as pool:
        return list(pool.map(started, places))


def _make_like(folder: Path, place: Path) -> None:
    """Make a folder that only its owner may enter; root gives it to the owner of `folder`."""
    try:
        place.mkdir(mode=0o700)
    except FileExistsError:
        return
    except OSError as error:
        raise DatabaseError(f"{place} cannot hold a server: {error.strerror}") from error
    if os.geteuid() == 0:
        owner = folder.stat()
        os.chown(place, owner.st_uid, owner.st_gid)

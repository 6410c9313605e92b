"""Where shards are: `shards=` in a URL, what libpq connects to for each, and private servers."""

import contextlib
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, quote, unquote, urlsplit

import psycopg
import pytest
from hypothesis import given
from hypothesis import strategies as st

from children import finished
from hapticdb.errors import DatabaseError, UsageError
from hapticdb.store.postgres.address import host_and_port, parse, with_environment
from hapticdb.store.postgres.private_server import Binaries, PrivateServer
from hapticdb.store.postgres.shards.connecting.places import private_shards, shard_conninfo
from hapticdb.store.urls import redact
from servers import Place, named
from sharded import N_SHARDS, SHARDED_FOUND, ShardedServers

BASE = "postgresql://anna@coordinator:5433/plant"
SECRET = "Xq7secretXq7"  # noqa: S105 - looked for in messages


def query_of(url: str) -> dict[str, str]:
    pairs = parse_qs(urlsplit(url).query, keep_blank_values=True, strict_parsing=True)
    assert all(len(values) == 1 for values in pairs.values())
    return {key: values[0] for key, values in pairs.items()}


def said(script: list[object], variables: dict[str, str] | None = None) -> str:
    """What a script prints in a process of its own."""
    command = [sys.executable, "-c", *map(str, script)]
    return finished(command, env={**os.environ, **(variables or {})}, check=True).stdout


# -- the address ---------------------------------------------------------------------------------


def test_a_url_without_shards_names_none() -> None:
    assert parse(BASE).shards == ()
    assert parse(f"{BASE}?environment=a").shards == ()


def test_shards_are_taken_from_the_url_and_do_not_reach_libpq() -> None:
    url = (
        f"{BASE}?shards=server1,server2:5433,%2Frun%2Fpg3,/run/pg4:5434,[::1]:6000&sslmode=require"
    )
    found = parse(f"{url}&environment=a")
    assert found.shards == ("server1", "server2:5433", "/run/pg3", "/run/pg4:5434", "[::1]:6000")
    assert found.conninfo == f"{BASE}?sslmode=require"
    assert found.environment == "a"


def test_another_environment_of_the_url_has_the_same_shards() -> None:
    url = with_environment(f"{BASE}?shards=server1,%2Frun%2Fa%2Cb%25&environment=a", "b")
    assert url == f"{BASE}?shards=server1,%2Frun%2Fa%2Cb%25&environment=b"
    assert parse(with_environment(f"{BASE}?shards=s1,s2", "b")).shards == ("s1", "s2")


@pytest.mark.parametrize(
    ("shard", "place"),
    [
        ("server1", ("server1", 5432)),
        ("Server-1.plant.example:1", ("server-1.plant.example", 1)),
        ("10.0.0.7:65535", ("10.0.0.7", 65535)),
        ("[fe80::1%eth0]:5433", ("fe80::1%eth0", 5433)),
        ("[::1]", ("::1", 5432)),
        ("/run/pg", ("/run/pg", 5432)),
        ("/run/pg/:5433", ("/run/pg", 5433)),
        ("/run/a b:c", ("/run/a b:c", 5432)),
    ],
)
def test_a_shard_has_a_host_and_a_port(shard: str, place: tuple[str, int]) -> None:
    assert host_and_port(shard) == place


@pytest.mark.parametrize(
    "value",
    [
        "",
        "server1,",
        ",server1",
        "server1,,server2",
        "3",
        "server1,3",
        "server1,3:5432",
        "server1:0",
        "server1:65536",
        "server1:",
        "server1:five",
        "::1",
        "anna@server1",
        "server 1",
        "server1%0A",
        "server1%2Cserver2",
        "/run/a%2C/run/b",
        "%FF",
        "/run/%FF",
        "/run/pg%09",
        "server1,server2,server1",
        "server1,server1:5432",
        "server1,SERVER1",
        "/run/pg,/run/pg/",
        "server1|",
        "server1||server2",
        "server1|server1",
        "server1|server2,server2",
        "[::1],[::1]:5432",
        ",".join(f"server{n}" for n in range(1, 1001)),
    ],
)
def test_what_names_no_servers_is_refused_in_one_line(value: str) -> None:
    with pytest.raises(UsageError, match="shard") as caught:
        parse(f"{BASE}?shards={value}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("attrs", "wanted"),
    [
        ("", "any"),
        ("target_session_attrs=any", "any"),
        ("target_session_attrs=prefer-standby", "prefer-standby"),
        ("target_session_attrs=standby", "prefer-standby"),
        ("target_session_attrs=read-write", "primary"),
    ],
)
def test_of_a_shard_with_standbys_that_server_is_taken_which_the_url_wants(
    attrs: str, wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PGTARGETSESSIONATTRS", raising=False)
    url = (
        f"{BASE}?{attrs}&shards=server1:5433|[::1],%2Frun%2Fpg|server3"
        if attrs
        else (f"{BASE}?shards=server1:5433|[::1],%2Frun%2Fpg|server3")
    )
    address = parse(url)
    assert address.shards == ("server1:5433|[::1]", "/run/pg|server3")
    known = [
        psycopg.conninfo.conninfo_to_dict(shard_conninfo(address, address.conninfo, host))
        for host in address.shards
    ]
    places = [(one["host"], one["port"], one["target_session_attrs"]) for one in known]
    assert places == [
        ("server1,::1", "5433,5432", wanted), ("/run/pg,server3", "5432,5432", wanted)
    ]  # fmt: skip


def test_999_shards_are_taken() -> None:
    hosts = tuple(f"server{n}" for n in range(1, 1000))
    assert parse(f"{BASE}?shards={','.join(hosts)}").shards == hosts


def test_a_second_list_of_shards_is_refused() -> None:
    with pytest.raises(UsageError, match="one list of shards"):
        parse(f"{BASE}?shards=server1&shards=server2")


folders = st.text(
    st.characters(exclude_categories=["C", "Z"], exclude_characters=",:|"), min_size=1
)


@given(st.lists(folders, min_size=1, max_size=5, unique_by=lambda name: f"/{name}".rstrip("/")))
def test_folders_of_sockets_come_out_as_they_went_in(names: list[str]) -> None:
    hosts = tuple(f"/{name}" for name in names)
    url = f"{BASE}?shards={','.join(quote(host, safe='') for host in hosts)}"
    assert parse(url).shards == hosts
    assert parse(with_environment(url, "other")).shards == hosts
    for host in hosts:
        made = shard_conninfo(parse(url), BASE, host)
        assert psycopg.conninfo.conninfo_to_dict(made)["host"] == (host.rstrip("/") or "/")


@pytest.mark.parametrize("count", [1, 3, 99])
def test_private_shards_are_a_number(count: int) -> None:
    found = parse(f"postgresql:///plant?data=/srv/plant&shards={count}")
    assert found.shards == tuple(str(n) for n in range(1, count + 1))
    assert (found.conninfo, found.data) == ("postgresql:///plant", "/srv/plant")


@pytest.mark.parametrize("value", ["", "0", "-1", "100", "03", "1.5", "server1", "1,2", "٣"])
def test_private_shards_that_are_no_number_are_refused(value: str) -> None:
    with pytest.raises(UsageError, match=r"number of private servers, 1 to 99$"):
        parse(f"postgresql:///plant?shards={value}&data=/srv/plant")


# -- passwords -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "value",
    [
        f"anna:{SECRET}@server1",
        f"server1,anna:{SECRET}@server2:5433",
        f"anna%3A{SECRET}%40server1",
        f"anna:{SECRET}%2540server1",
        f"server1?password={SECRET}",
        f"server1%3Fpassword%3D{SECRET}",
    ],
)
@pytest.mark.parametrize("base", [BASE, "postgresql://coordinator:5433/plant", "postgresql:///p"])
def test_a_password_among_the_shards_is_refused_and_not_shown(base: str, value: str) -> None:
    url = f"{base}?shards={value}"
    assert SECRET not in redact(url)
    with pytest.raises(UsageError) as caught:
        parse(url)
    assert SECRET not in str(caught.value)


def test_shards_without_a_password_are_shown() -> None:
    url = f"{BASE}?shards=server1,server2:5433,%2Frun%2Fpg&environment=a"
    assert parse(url).shown == redact(url) == url
    hidden = f"postgresql://anna:{SECRET}@coordinator/plant?shards=server1"
    assert redact(hidden) == "postgresql://anna@coordinator/plant?shards=server1"


@pytest.mark.parametrize(
    "coordinator",
    [
        f"postgresql://anna:{SECRET}@coordinator:5433/plant?sslmode=require",
        f"postgresql://coordinator/plant?user=anna&password={SECRET}&sslmode=require",
        f"postgresql://anna@c1:1,c2:2/plant?p%61ssword={SECRET}&sslmode=require",
        f"postgresql:///plant?user=anna&scram_client_key={SECRET}&sslmode=require&host=/run/pg",
        f"postgresql:///plant?user=anna&oauth_client_secret={SECRET}&sslmode=require",
        f"postgresql:///plant?user=anna&passw%6Frd={SECRET}&hostaddr=127.0.0.1&sslmode=require",
    ],
)
def test_no_password_goes_to_a_shard(coordinator: str) -> None:
    made = shard_conninfo(parse(coordinator), coordinator, "server2:5434")
    assert SECRET not in made
    assert "coordinator" not in made
    known = psycopg.conninfo.conninfo_to_dict(made)
    assert (known["host"], known["port"]) == ("server2", "5434")
    assert (known["user"], known["dbname"], known["sslmode"]) == ("anna", "plant", "require")
    assert (known["password"], known["hostaddr"]) == ("", "")


def test_a_shard_has_the_coordinators_other_settings() -> None:
    kept = {"sslrootcert": "/ca.pem", "sslcert": "/anna.pem", "options": "-cgeqo=off"}
    kept |= {"connect_timeout": "3", "passfile": "/anna/passwords", "channel_binding": "require"}
    dropped = "target_session_attrs=read-write&load_balance_hosts=random&gssdelegation=1"
    pairs = "&".join(f"{key}={quote(value, safe='')}" for key, value in kept.items())
    url = f"postgresql://an%40na@c1,c2/pl%2Fant?{pairs}&{dropped}"
    known = query_of(shard_conninfo(parse(url), parse(url).conninfo, "[::1]:5433"))
    ours = {"host": "::1", "port": "5433", "hostaddr": "", "password": ""}
    assert known == kept | ours | {"target_session_attrs": "any"}
    made = psycopg.conninfo.conninfo_to_dict(shard_conninfo(parse(url), url, "server1"))
    assert (made["user"], made["dbname"]) == ("an@na", "pl/ant")


@pytest.mark.parametrize("host", ["", "1", "a,b", "anna@server1", "server1&password=x", "a\nb"])
def test_a_catalogue_with_something_else_than_a_host_is_refused(host: str) -> None:
    with pytest.raises(UsageError, match="is no address of a shard"):
        shard_conninfo(parse(BASE), BASE, host)


CONNECT = """
import sys
import psycopg
with psycopg.connect(sys.argv[1]) as connection:
    print(connection.info.password, connection.info.host)
"""


@pytest.mark.long
def test_the_variables_of_the_coordinator_do_not_reach_a_shard(
    sharded_servers: ShardedServers, tmp_path: Path
) -> None:
    services = tmp_path / "services"
    services.write_text(f"[plant]\nhost=/nowhere\nport=1\npassword={SECRET}\nhostaddr=192.0.2.1\n")
    for variables in (
        {"PGPASSWORD": SECRET, "PGHOSTADDR": "192.0.2.1", "PGPORT": "1", "PGHOST": "/nowhere"},
        {"PGSERVICE": "plant", "PGSERVICEFILE": str(services)},
        {"PGTARGETSESSIONATTRS": "standby"},
    ):
        url = shard_conninfo(parse(BASE), sharded_servers.url, sharded_servers.hosts[1])
        assert said([CONNECT, url], variables).split() == [sharded_servers.hosts[1]], variables


# -- the servers of the tests --------------------------------------------------------------------


@pytest.mark.long
def test_the_shards_of_the_tests_are_servers_of_their_own(
    sharded_servers: ShardedServers, sharded_place: Place
) -> None:
    address = parse(sharded_place())
    assert address.shards == sharded_servers.hosts
    assert len(address.shards) == N_SHARDS
    assert parse(sharded_place()).environment != address.environment
    urls = [shard_conninfo(address, address.conninfo, host) for host in address.shards]
    folders = set()
    for url in [address.conninfo, *urls]:
        with psycopg.connect(url) as connection:
            folders |= set(connection.execute("SHOW data_directory"))
            (major,) = connection.execute("SHOW server_version_num").fetchone() or ("",)
            assert int(major) // 10_000 == sharded_servers.coordinator.binaries.major
    assert len(folders) == 1 + N_SHARDS


# -- private servers -----------------------------------------------------------------------------


@pytest.fixture
def folder() -> Iterator[Path]:
    """A short folder; servers below it end with the test."""
    made = Path(tempfile.mkdtemp(prefix="shards-")).resolve()
    yield made
    for data in made.rglob("data"):
        with contextlib.suppress(DatabaseError):
            PrivateServer.at(data.parent).stop()
    for socket in made.rglob("socket"):
        shutil.rmtree(socket.resolve())
    shutil.rmtree(made)


PRIVATE = """
import sys
from pathlib import Path
import psycopg
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.store.postgres.shards.connecting.places import private_shards

folder = Path(sys.argv[1])
for n, making in enumerate((sys.argv[2] == "making", False)):
    urls = private_shards(folder, 2, making=making, database="pla nt")
    for number, url in enumerate(urls, 1):
        with psycopg.connect(url) as connection:
            print(connection.info.dbname, connection.execute("SHOW data_directory").fetchone()[0],
                  connection.execute("SHOW server_version_num").fetchone()[0], sep="|")
            connection.execute("CREATE TABLE IF NOT EXISTS kept AS SELECT 7")
"""


@pytest.mark.long
@pytest.mark.parametrize("binaries", SHARDED_FOUND, ids=named)
def test_private_shards_start_and_end_with_the_process(folder: Path, binaries: Binaries) -> None:
    PrivateServer.at(folder, binaries)
    for making in ("making", "opening"):
        found = [line.split("|") for line in said([PRIVATE, folder, making]).splitlines()]
        data = [str(folder / "shards" / n / "data") for n in "12"]
        assert [row[:2] for row in found] == [["pla nt", d] for d in data] * 2
        assert {int(row[2]) // 10_000 for row in found} == {binaries.major}
        shards = [PrivateServer.at(folder / "shards" / n) for n in "12"]
        assert not any(shard.is_running for shard in shards)
    # the coordinator's folder is still a server's
    PrivateServer.at(folder)
    modes = [p.stat().st_mode & 0o777 for p in (folder / "shards", folder / "shards" / "1")]
    assert modes == [0o700] * 2
    assert (folder / "shards" / "2").stat().st_uid == os.geteuid()


@pytest.mark.long
def test_a_missing_private_shard_is_not_made_anew(folder: Path) -> None:
    PrivateServer.at(folder, SHARDED_FOUND[0])
    place = folder / "shards" / "1"
    told = re.escape(f"shard 1 is missing: {place} holds no server")
    with pytest.raises(DatabaseError, match=told):
        private_shards(folder, 1, making=False, database="plant")
    place.mkdir(parents=True)
    with pytest.raises(DatabaseError, match=told):
        private_shards(folder, 1, making=False, database="plant")
    (folder / "shards" / "1" / "mine").touch()
    with pytest.raises(DatabaseError, match=f"{place} holds something else"):
        private_shards(folder, 1, making=True, database="plant")
    assert unquote(place.name) == "1"

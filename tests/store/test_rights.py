"""Roles: their rights over plain connections and through hapticdb; passwords stay hidden."""

import contextlib
import json
import os
import socket
import tempfile
import threading
import traceback
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from urllib.parse import quote

import numpy as np
import psycopg
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from psycopg import sql
from psycopg.errors import InsufficientPrivilege

import hapticdb
import servers
from command_line import PLACES, Run, boxes, poses, refused, tool
from hapticdb import Grid, PointShell
from hapticdb.cli import app
from hapticdb.difference import diff_environments
from hapticdb.errors import AccessError, HapticDBError, ReadOnlyError, UsageError
from hapticdb.paper import cost_model, quantiles
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.store.connect import grant
from hapticdb.store.engines import Right
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.postgres_store import PostgresStore
from hapticdb.store.urls import redact
from hapticdb.transfer import copy_environment
from postgres_servers import Server, serving
from servers import FOUND, SETTINGS, Place
from voxels import floor_voxels, write_voxels

GRID = Grid(0.005, (0, 0, 0), 7)
PASSWORD = 'no\' "secret" %40'  # noqa: S105 - of roles that live as long as a test
NAMES: dict[Right, str] = {
    "viewer": 'Vera "V" {0}',
    "toucher": "tom'; DROP SCHEMA {schema} CASCADE; --",
    "editor": 'Ed\\";DROP TABLE object; %s "',
    "nobody": "SELECT",
}


@pytest.fixture
def roles(admin: psycopg.Connection) -> Iterator[dict[Right, str]]:
    """One role for each right, with a name that needs quotes; dropped after the test."""
    names = {right: f"{os.getpid()} {name}" for right, name in NAMES.items()}
    with servers.roles(admin, *names.values(), password=PASSWORD):
        yield names


@pytest.fixture
def url(place: Place) -> str:
    """URL of a small environment that the owner has made."""
    where = place()
    store = PostgresStore.create(where, GRID)
    write_voxels(store, floor_voxels(GRID), "floor")
    store.analyze(quantiles.DEFAULT_RESOLUTION)
    store.close()
    return where


@pytest.fixture
def granted(url: str, roles: dict[Right, str]) -> dict[Right, str]:
    """Right -> URL of the environment with the role that was granted this right."""
    for right, role in roles.items():
        grant(url, role, right)
    return {right: url_as(url, role) for right, role in roles.items()}


url_as = partial(servers.url_as, password=PASSWORD)


# -- what the server lets a role do: @ stands for the schema --------------------------------------

A_COLUMN = {
    "environment": "revision",
    "object": "name",
    "voxel": "z_val",
    "brick": "occupancy",
    "surface": "geometry",
    "pair": "kind",
    "rule": "says",
    "change": "action",
    "quantile": "bounds",
    "cost": "machine",
}
GRID_COLUMNS = (
    "id", "version", "voxel_size", "origin_x", "bits", "curve", "layout", "wants_distances",
)  # fmt: skip
# no row is affected: the server checks rights before it reads rows
SELECT = {table: f"SELECT * FROM @{table}" for table in A_COLUMN}
INSERT = {table: f"INSERT INTO @{table} SELECT * FROM @{table} WHERE false" for table in A_COLUMN}
UPDATE = {t: f"UPDATE @{t} SET {column} = {column} WHERE false" for t, column in A_COLUMN.items()}
DELETE = {table: f"DELETE FROM @{table} WHERE false" for table in A_COLUMN}
OWNING = {
    *(f"UPDATE @environment SET {column} = {column} WHERE false" for column in GRID_COLUMNS),
    *(f"TRUNCATE @{table}" for table in A_COLUMN),
    *(f"DROP TABLE @{table}" for table in A_COLUMN),
    *(f"ALTER TABLE @{table} ADD COLUMN extra int" for table in A_COLUMN),
    *(f"CREATE INDEX ON @{table} ({column})" for table, column in A_COLUMN.items()),
    "CREATE TABLE @more (a int)",
    "CREATE VIEW @more AS SELECT 1",
    "CREATE FUNCTION @more() RETURNS int LANGUAGE sql AS 'SELECT 1'",
    "CREATE OR REPLACE FUNCTION @refresh_statistics() RETURNS void LANGUAGE sql AS ''",
    "CREATE TRIGGER t BEFORE UPDATE ON @object EXECUTE FUNCTION tsvector_update_trigger()",
    "CREATE RULE r AS ON DELETE TO @object DO INSTEAD NOTHING",
    "DROP INDEX @brick_key",
    "DROP FUNCTION @refresh_statistics",
    "DROP TYPE @hit CASCADE",
}
HAS_VOXEL = "SELECT @has_voxel(occupancy, 0) FROM @brick"
FORCE = "SELECT @force(ROW(0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0)::@hit)"
VIEWING = {*SELECT.values(), FORCE, HAS_VOXEL}
ALLOWED: dict[Right, set[str]] = {
    "nobody": set(),
    "viewer": VIEWING,
    "toucher": {*VIEWING, INSERT["cost"], UPDATE["cost"]},
    "editor": {
        *VIEWING,
        *(INSERT[t] for t in A_COLUMN if t != "environment"),
        *(UPDATE[t] for t in A_COLUMN if t != "change"),
        *(DELETE[t] for t in ("object", "voxel", "brick", "surface", "pair", "rule")),
        "SELECT @refresh_statistics()",
        "SELECT nextval('@object_id_seq')",
        "SELECT setval('@object_id_seq', 1000)",
        "SELECT last_value FROM @object_id_seq",
    },
}
EVERYTHING = {*INSERT.values(), *UPDATE.values(), *DELETE.values(), *OWNING, *ALLOWED["editor"]}


def allowed(url: str) -> set[str]:
    """Statements that the URL's user may run; each is rolled back. The server forbids the rest."""
    address = parse(url)
    found = set()
    with psycopg.connect(address.conninfo) as connection:
        for text in EVERYTHING:
            statement = text.replace("@", f"{address.environment}.")
            with contextlib.suppress(InsufficientPrivilege):
                connection.execute(statement.encode())
                found.add(text)
            connection.rollback()
    return found


def test_grant_last_right_holds(url: str, roles: dict[Right, str]) -> None:
    role = roles["editor"]
    for right in ("editor", "viewer", "toucher", "nobody"):
        grant(url, role, right)
        grant(url, role, right)
        assert allowed(url_as(url, role)) == ALLOWED[right], right


def test_grant_not_passed_on_by_editor(url: str, roles: dict[Right, str]) -> None:
    grant(url, roles["editor"], "editor")
    role, schema = sql.Identifier(roles["nobody"]), sql.Identifier(parse(url).environment)
    theirs = parse(url_as(url, roles["editor"])).conninfo
    with psycopg.connect(theirs, autocommit=True) as connection:
        # the server only warns, and grants nothing
        connection.execute(sql.SQL("GRANT USAGE ON SCHEMA {} TO {}").format(schema, role))
        connection.execute(sql.SQL("GRANT SELECT ON {}.brick TO {}").format(schema, role))
        connection.execute(sql.SQL("GRANT SELECT ON {}.brick TO PUBLIC").format(schema))
    assert allowed(url_as(url, roles["nobody"])) == set()


def test_grant_by_owner_only(granted: dict[Right, str], roles: dict[Right, str]) -> None:
    for right, url in granted.items():
        for role in (roles["nobody"], roles[right]):
            with pytest.raises(AccessError, match=r"only the owner|may not read"):
                grant(url, role, "editor")
    assert allowed(granted["nobody"]) == set()


def test_grant_owner_and_members_refused(
    url: str, roles: dict[Right, str], admin: psycopg.Connection
) -> None:
    owner = admin.info.user
    with pytest.raises(UsageError, match="is the owner"):
        grant(url, owner, "viewer")
    member = roles["viewer"]
    admin.execute(sql.SQL("GRANT {} TO {}").format(*map(sql.Identifier, (owner, member))))
    with pytest.raises(UsageError, match="a member of the owner"):
        grant(url, member, "viewer")
    admin.execute(sql.SQL("REVOKE {} FROM {}").format(*map(sql.Identifier, (owner, member))))
    assert allowed(url) == EVERYTHING


def test_grant_viewer_reads_by_every_strategy(
    granted: dict[Right, str], url: str, sphere: PointShell
) -> None:
    pose = np.eye(4)
    pose[:3, 3] = (0.32, 0.32, 0.325)
    with hapticdb.open(url) as own, hapticdb.open(granted["viewer"], read_only=True) as env:
        for strategy in STRATEGIES:
            touch, expected = (e.touch(sphere, pose, strategy, law="plane") for e in (env, own))
            assert len(touch.hits) > 0
            np.testing.assert_array_equal(touch.force, expected.force)
        assert [obj.name for obj in env.objects()] == ["floor"]
        assert env.quantiles().n_rows == env.size().rows
    with pytest.raises(ReadOnlyError, match=r"can only be read .*hapticdb grant URL ROLE"):
        hapticdb.open(granted["viewer"])
    assert diff_environments(url, granted["viewer"]).is_equal


def test_grant_toucher_stores_costs_only(granted: dict[Right, str], url: str) -> None:
    with hapticdb.open(granted["toucher"]) as env:
        figures = env.calibrate().figures()
        env.calibrate()
        for refused in (
            lambda: env.remove(1),
            lambda: write_voxels(env.store, floor_voxels(GRID), "another"),
            lambda: env.store.analyze(quantiles.DEFAULT_RESOLUTION, anew=True),
            lambda: env.store.loading().__enter__(),  # refused before a file is read or voxelized
        ):
            with pytest.raises(ReadOnlyError, match="hapticdb grant URL ROLE --as editor"):
                refused()
        assert [obj.name for obj in env.objects()] == ["floor"]
    with hapticdb.open(url) as own:
        kept = own.store.costs(cost_model.machine_name())
    assert kept is not None
    assert set(kept) == set(figures)


def test_grant_editor_imports_moves_removes(
    run: Run, place: Place, roles: dict[Right, str], tmp_path: Path
) -> None:
    url = place()
    assert run("import", url, boxes(tmp_path / "a.glb"), "--bits", 6)[0] == 0
    assert run("grant", url, roles["editor"], "--as", "editor")[0] == 0
    theirs = url_as(url, roles["editor"])
    for args in (
        ("import", theirs, boxes(tmp_path / "b.glb", 2)),
        ("move", theirs, 4, "--translate", "0,0,0.02"),
        ("remove", theirs, 2),
        ("info", theirs, "--calibrate"),
    ):
        assert run(*args)[0] == 0, args
    with hapticdb.open(url) as own:
        assert [(obj.id, obj.name) for obj in own.objects()] == [
            *((1, "box0"), (3, "box2"), (4, "box0"), (5, "box1"))
        ]
        assert own.store.freshness(quantiles.DEFAULT_RESOLUTION).revision is not None


def test_grant_editor_fills_empty_environment(
    place: Place, roles: dict[Right, str], tmp_path: Path
) -> None:
    url, source = place(), tmp_path / "a.db"
    PostgresStore.create(url, GRID, "voxel").close()
    grant(url, roles["editor"], "editor")
    with hapticdb.create(source, GRID, layout="voxel") as env:
        write_voxels(env.store, floor_voxels(GRID), "gone")
        write_voxels(env.store, floor_voxels(GRID, 64, 64), "kept")
        env.remove(1)
    theirs = url_as(url, roles["editor"])
    assert copy_environment(source, theirs).copied == 1
    with hapticdb.open(theirs) as env:
        assert env.quantiles().source == "server statistics"
        # the id of a copied object is never given to another
        env.remove(2)
        assert write_voxels(env.store, floor_voxels(GRID), "new") == 3


def test_create_without_privilege(place: Place, roles: dict[Right, str]) -> None:
    with pytest.raises(AccessError, match="may not make one"):
        hapticdb.create(url_as(place(), roles["editor"]), GRID)


def test_open_environment_right_withdrawn(
    granted: dict[Right, str], url: str, roles: dict[Right, str]
) -> None:
    env = hapticdb.open(granted["editor"])
    grant(url, roles["editor"], "viewer")
    with pytest.raises(ReadOnlyError, match="may not do that"):
        env.remove(1)
    grant(url, roles["editor"], "nobody")
    with pytest.raises(hapticdb.errors.DamagedError, match="or this user may no longer use it"):
        env.objects()
    with pytest.raises(AccessError, match="may not read"):
        hapticdb.open(granted["editor"])
    grant(url, roles["editor"], "editor")
    env.remove(1)
    env.close()


def test_grant_verb_output(run: Run, url: str, roles: dict[Right, str]) -> None:
    words = ("grant", url, roles["toucher"], "--as", "toucher")
    code, out, err = run(*words)
    assert (code, err, len(out.splitlines())) == (0, "", 1)
    assert f"{roles['toucher']} may read and touch" in out
    found = json.loads(run(*words, "--json")[1])
    assert list(found) == ["environment", "role", "right"]
    assert (found["role"], found["right"]) == (roles["toucher"], "toucher")
    refused(run("grant", url, "nobody at all", "--as", "viewer"), "createuser")
    refused(run("grant", url, roles["viewer"]), "--as")
    refused(run("grant", url, roles["viewer"], "--as", "owner"), "viewer")
    refused(run("grant", "a.db", "anna", "--as", "viewer"), "SQLite, which has no roles")


MARK = "Zq7"
# no server listens on port 1
UNREACHABLE = "127.0.0.1:1"
SECRET_KEYS = ("password", "p%61ssword", "sslpassword", "oauth_client_secret", "scram_client_key")
passwords = st.builds(
    f"{MARK}{{}}{MARK}{{}}{MARK}".format,
    *(st.text(st.characters(exclude_categories=["Cs"]), max_size=5) for _ in range(2)),
)


def urls_with(password: str) -> Iterator[str]:
    """URLs with the password in each place where libpq reads one, escaped and plain."""
    escaped = quote(password, safe="")
    for text in (escaped, password):
        yield f"postgresql://anna:{text}@{UNREACHABLE}/plant"
        yield f"POSTGRES://:{text}@{UNREACHABLE}/plant?sslmode=disable&environment=a"
    for key in SECRET_KEYS:
        yield f"postgresql://anna@{UNREACHABLE}/plant?{key}={escaped}&connect_timeout=5"
        if "&" not in password:
            yield f"postgresql://anna@{UNREACHABLE}?environment=a&{key}={password}"
    yield f"postgresql:anna:{password}@{UNREACHABLE}/plant"
    yield f"host=127.0.0.1 port=1 password={password}"


@given(passwords)
@example(f"{MARK}/{MARK}?{MARK}#{MARK}@{MARK}")
@example(f"5432/{MARK}@{MARK}%zz{MARK}")
@example(f"{MARK}[{MARK}]\u2100{MARK}\n{MARK}\0{MARK}")
def test_redact_passwords_in_messages_and_tracebacks(password: str) -> None:
    for url in urls_with(password):
        if url.startswith(("postgresql://", "POSTGRES://")):
            assert MARK not in redact(url), url
        with pytest.raises(HapticDBError) as caught:
            hapticdb.open(url)
        told = "".join(traceback.format_exception(caught.value))
        assert MARK not in told, url


@given(st.text(st.characters(exclude_categories=["Cs"]), max_size=9))
def test_redact_only_secrets(password: str) -> None:
    rest = "@host:5433/plant?environment=a&sslmode=require"
    shown = redact(f"postgresql://anna:{quote(password, safe='')}{rest}")
    assert shown == f"postgresql://anna{rest}"


def lines(url: str) -> dict[str, list[str]]:
    """Arguments for each verb that takes a URL, in an order in which all succeed."""
    by = ("--tool", "tool.stl")
    return {"import": [url, "boxes.glb", "--bits", "6"]} | {
        **{verb: [url] for verb in ("info", "objects", "check")},
        "touch": [url, *by, "--poses", "path.csv"],
        "feel": [url, *by, "--device", "path.csv", "--seconds", "0.2", "--record", "felt.hdbrec"],
        "replay": ["felt.hdbrec", url],
        "sweep": [url, *by, "--path", "path.csv"],
        "reach": [url, "1", *by, "--axis", "0,0,1", "--step", "180"],
        "move": [url, "1", "--translate", "0,0,0.01"],
        **{verb: [url, "copy.db"] for verb in ("copy", "diff")},
        "grant": [url, "pg_monitor", "--as", "viewer"],
        "clashes": [url],
        "distance": [url, "1", "2"],
        **{verb: [url, "1"] for verb in ("extract", "remove")},
        "demo": ["shown", "--url", url],
        "view": [url, "--no-browser", "--seconds", "1"],
        "serve": [url, "--seconds", "1"],
    }


@pytest.fixture
def files(tmp_path: Path) -> None:
    boxes(tmp_path / "boxes.glb")
    tool(tmp_path / "tool.stl")
    poses(tmp_path / "path.csv", *PLACES)


def test_redact_checks_cover_every_verb() -> None:
    verbs = {c.name for c in app.registered_commands} - {"sample", "warm", "backup"}
    assert verbs == {*lines("")}


@pytest.mark.long
@pytest.mark.usefixtures("files")
def test_verbs_print_no_password(run: Run, place: Place) -> None:
    url = f"{place()}&password={MARK}&sslpassword={MARK}"
    for verb, args in lines(url).items():
        if verb != "demo":  # the demo takes long
            code, out, err = run("--debug", verb, *args)
            is_well = code in {0, {"sweep": 1, "clashes": 1}.get(verb, 0)}
            assert (is_well, MARK in out + err) == (True, False), (verb, out, err)
    for verb in ("info", "touch", "remove", "copy", "grant"):
        code, out, err = run("--debug", verb, *lines(f"{url}&environment=missing")[verb])
        assert (code, MARK in out + err) == (2, False), (verb, out, err)


@pytest.fixture(scope="module")
def guarded() -> Iterator[Server]:
    """A server that asks the role `anna` for her password."""
    with serving(Path(tempfile.mkdtemp(prefix="guarded-")), FOUND[0], SETTINGS) as server:
        rules = server.data / "pg_hba.conf"
        rules.write_text(f"local all anna scram-sha-256\n{rules.read_text()}")
        with psycopg.connect(server.conninfo(), autocommit=True) as connection:
            connection.execute(sql.SQL("CREATE ROLE anna LOGIN PASSWORD {}").format(PASSWORD))
            connection.execute("SELECT pg_reload_conf()")
        hapticdb.create(server.conninfo(), GRID).close()
        grant(server.conninfo(), "anna", "viewer")
        yield server


def test_open_password_sources_of_libpq(
    guarded: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    url = guarded.conninfo().replace("user=hapticdb", "user=anna")
    with pytest.raises(AccessError, match="no password"):
        hapticdb.open(url)
    with pytest.raises(AccessError, match='"nobody_here" does not exist'):
        hapticdb.open(url.replace("user=anna", "user=nobody_here"))
    for wrong in (f"{url}&password={MARK}", url.replace("///", f"//:{MARK}@/")):
        with pytest.raises(AccessError, match="authentication failed") as caught:
            hapticdb.open(wrong)
        assert MARK not in "".join(traceback.format_exception(caught.value))
    right = f"{url}&password={quote(PASSWORD, safe='')}"
    with hapticdb.open(right, read_only=True) as env:
        assert "password=***" in repr(env)
        assert quote(PASSWORD) not in repr(env)
    keeper = tmp_path / "pgpass"
    keeper.write_text(f"*:*:*:anna:{PASSWORD}\n")
    keeper.chmod(0o600)
    hapticdb.open(f"{url}&passfile={quote(str(keeper))}", read_only=True).close()
    monkeypatch.setenv("PGPASSWORD", PASSWORD)
    hapticdb.open(url, read_only=True).close()


@pytest.mark.parametrize("mode", ["require", "verify-full&sslrootcert=system"])
def test_open_tls_required(mode: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def decline() -> None:
            with listener.accept()[0] as client:
                client.recv(8)
                client.sendall(b"N")  # the answer of a server without TLS

        threading.Thread(target=decline, daemon=True).start()
        where = f"127.0.0.1:{listener.getsockname()[1]}/plant"
        with pytest.raises(HapticDBError, match="server does not support SSL") as caught:
            hapticdb.open(f"postgresql://anna:{MARK}@{where}?sslmode={mode}")
    assert "\n" not in str(caught.value)
    assert MARK not in str(caught.value)

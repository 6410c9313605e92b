"""A server on PostgreSQL whose addresses are of users with few rights: browsers cannot write."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from psycopg import sql

import hapticdb
from assemblies import row_of_boxes
from children import until
from hapticdb import Grid, find_clashes
from hapticdb.server.access import Role
from hapticdb.server.served import Serving
from hapticdb.store.connect import grant
from hapticdb.store.postgres.address import parse
from page_person import PagePerson
from servers import PASSWORD, Place, roles, url_as
from serving import TOKENS, running
from voxels import blob, write_voxels

GRID = Grid(0.01, (-0.1, -0.1, -0.1), 6)


@pytest.fixture
def urls(place: Place, admin: psycopg.Connection) -> Iterator[dict[Role, str]]:
    """The environment's address as its viewer, as its toucher and as its editor."""
    url = place()
    with hapticdb.create(url, GRID) as env:
        write_voxels(env.store, blob(1, (20, 20, 20)), "wheel")
        write_voxels(env.store, blob(2, (40, 40, 40)), "door")
    names = {role: f"hapticdb_test_{role.word}_{os.getpid()}" for role in Role}
    with roles(admin, *names.values()):
        for role, name in names.items():
            grant(url, name, role.word)  # type: ignore[arg-type]
        yield {role: url_as(url, name) for role, name in names.items()}


def stored(admin: psycopg.Connection, url: str) -> list[object]:
    """Everything that is stored in an environment, as the owner sees it."""
    schema = sql.Identifier(parse(url).environment)
    found: list[object] = []
    for table in ("environment", "object", "brick", "change"):
        query = sql.SQL("SELECT * FROM {}.{} ORDER BY 1, 2").format(schema, sql.Identifier(table))
        found += admin.execute(query).fetchall()
    return found


def take_the_wheel_out(person: PagePerson) -> None:
    person.put(person.find("", "wheel"), "wheel")
    person.choose("For everyone", "Take out")


@pytest.mark.long
def test_server_viewer_login_cannot_write(urls: dict[Role, str], admin: psycopg.Connection) -> None:
    """Whoever has stolen even the editor's token: the database refuses."""
    url = urls[Role.VIEWER]
    before = stored(admin, url)
    serving = Serving(dict.fromkeys(Role, url), tokens=TOKENS)
    with running(serving) as server, server.browser(Role.EDITOR) as browser:
        person = PagePerson(browser)
        take_the_wheel_out(person)
        until(person.look)
        person.put_everything()
        assert server.ask("/healthz")[0].status == 200
    assert stored(admin, url) == before
    told = "".join(person.told)
    for word in (PASSWORD, "hapticdb_test", parse(url).environment, "Traceback"):
        assert word not in told


@pytest.mark.long
def test_server_role_selects_database_url(urls: dict[Role, str], admin: psycopg.Connection) -> None:
    """The same steps change nothing for a viewer and a toucher, and do for an editor."""
    url = urls[Role.VIEWER]
    before = stored(admin, url)
    with running(Serving(urls, tokens=TOKENS)) as server:
        for role in (Role.VIEWER, Role.TOUCHER):
            with server.browser(role) as browser:
                person = PagePerson(browser)
                take_the_wheel_out(person)
                person.put_everything()
            assert stored(admin, url) == before
        with server.browser(Role.EDITOR) as browser:
            person = PagePerson(browser)
            take_the_wheel_out(person)
            until(lambda: (person.look(), stored(admin, url) != before)[1])
    with contextlib.closing(hapticdb.open(url, read_only=True)) as env:
        assert [obj.name for obj in env.objects()] == ["door"]


def test_server_clashes_viewer_reads_editor_accepts(urls: dict[Role, str], tmp_path: Path) -> None:
    file = row_of_boxes(tmp_path / "row.db", 2, 0.099).with_suffix(".glb")
    with hapticdb.open(urls[Role.EDITOR]) as env:
        for obj in env.objects():
            env.remove(obj.id)
        env.add(file)
        (pair,) = find_clashes(env).pairs
        env.store.put_pairs([], [pair[:2]])
        with running(Serving(urls, tokens=TOKENS)) as server:
            with server.browser(Role.VIEWER) as browser:
                person = PagePerson(browser)
                person.press("Look for clashes")
                person.wait_for("1 overlapping. They are not kept")
                person.choose("Group", "Accept")
                person.wait_for("this takes the role editor")
                assert list(env.store.pairs()) == []
            with server.browser(Role.EDITOR) as browser:
                person = PagePerson(browser)
                person.press("Look for clashes")
                person.wait_for("1 overlapping.")
                listed = person.widgets[person.find("Groups")]
                until(lambda: (person.look(0.05), len(listed["options"]) == 2)[1])
                person.choose("Groups", listed["options"][1])
                person.wait_for("Orange")
                person.choose("Because", "welded")
                person.choose("Group", "Accept")
                person.wait_for("the pairs are accepted")
                (row,) = env.store.pairs()
                assert (row.kind, row.because) == ("overlapping", "welded")
                person.choose("Group", "Take back")
                person.wait_for("no longer accepted")
                assert next(iter(env.store.pairs())).because is None
                person.wait_for("cube0 in cube1: overlap up to 1.")
                person.press("Add rule")
                person.wait_for("the rule is kept")
                person.press("Look for clashes")
                person.wait_for("1 pair, 1 meant")
                person.wait_for("0 of 1 groups")

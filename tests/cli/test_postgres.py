"""The command line on PostgreSQL: the same as on a file, and a server's own failures."""

import re
import shutil
from pathlib import Path

import pytest

from cli.test_verbs import (  # noqa: F401 - the same lines again, on the fixture `scene` below
    test_info_calibrate_spread,
    test_info_json_equals_library,
    test_info_renews_statistics_after_many_edits,
    test_info_text,
)
from command_line import Run, refused, rows_of
from hapticdb.store.urls import redact
from servers import Place


@pytest.fixture
def scene(run: Run, made: Path, tmp_path: Path, place: Place) -> str:
    """The environment of three boxes on a server, with tool and path in the folder.

    The environment is copied, since an import would start a process to read the file.
    """
    for name in ("tool.stl", "tool.npz", "path.csv"):
        shutil.copy(made / name, tmp_path)
    url = place()
    assert run("copy", made / "scene.db", url)[0] == 0
    return url


# -- import ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ["brick", "voxel"])
def test_import_postgres_same_rows_as_sqlite(
    run: Run, made: Path, place: Place, layout: str
) -> None:
    url, file = place(), made / "boxes.glb"
    options = (file, "--bits", 6, "--layout", layout)
    code, out, err = run("import", url, *options)
    assert (code, err) == (0, "")
    assert "3 objects imported" in out
    assert f"{redact(url)}: 3 objects" in out
    assert run("import", "file.db", *options)[0] == 0
    assert rows_of(url) == rows_of("file.db")
    before = rows_of(url)
    code, out, err = run("import", url, *options)
    assert (code, err) == (0, "")
    assert "complete already (3 objects), nothing to do" in out
    assert rows_of(url) == before


# -- failures that only a server has --------------------------------------------------------------


def test_info_postgres_unreachable(run: Run, tmp_path: Path) -> None:
    refused(run("info", f"postgresql:///x?host={tmp_path}"), "cannot be reached")
    refused(run("info", "postgresql://127.0.0.1:1/x"), "cannot be reached", "refused")
    unescaped = "postgresql://me:h@nter@localhost:1/x"
    assert "nter" not in refused(run("info", unescaped), "%40")


def test_info_postgres_missing_database(run: Run, database: str, made: Path) -> None:
    url = re.sub(r"(://[^/]*)/[^?]*", r"\1/nowhere", database)
    refused(run("info", url), '"nowhere" does not exist', "createdb")
    refused(run("import", url, made / "boxes.glb"), '"nowhere" does not exist', "createdb")

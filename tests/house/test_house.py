"""Rules of the project, checked on the sources: imports, texts, waits, public names."""

import ast
import inspect
import os
import re
import shutil
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import hapticdb
from children import finished
from hapticdb.kernels._cache import sources_digest
from sources import PACKAGE, ROOT, modules, named, python_files, tree

# domains that may import less than their floor allows -> what they may import
NARROW: dict[str, set[str]] = {
    "kernels": set(),
    "closing": set(),
    "errors": set(),
    "interrupting": set(),
    "poses": {"errors", "tabular", "units"},
    "mesh": {"errors", "poses", "units"},
    "devices": {"errors", "kernels", "poses"},
    "sample": {"errors", "tabular"},
}
PUBLIC = hapticdb.__all__


def domain(path: Path) -> str:
    """Domain of a source: the module or folder directly below the package."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def drawn_floors() -> list[set[str]]:
    """Domains on each line of the drawing, from the top.

    A module may import from its own floor and the floors below it.
    """
    page = (ROOT / "ARCHITECTURE.md").read_text()
    block = page.partition("## Rooms and floors")[2].split("```")[1]
    lines = [{word.rstrip("/") for word in line.split()} for line in block.splitlines()]
    known = {domain(path) for path in modules()} - {"__init__"}
    return [found for words in lines if (found := words & known)]


LEVELS = {name: level for level, floor in enumerate(drawn_floors()) for name in floor}


@cache
def imported(path: Path) -> set[str]:
    """Dotted names of all that a source imports, at its top or inside a function."""
    found: set[str] = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{named(path)} imports relatively"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def own(path: Path) -> set[str]:
    """Domains of the package that a source imports, without its own domain."""
    found = {name.split(".")[1] for name in imported(path) if name.startswith("hapticdb.")}
    return found - {domain(path)}


# --- imports ------------------------------------------------------------------------------------


def test_levels_every_module_drawn() -> None:
    drawn = sorted(name for floor in drawn_floors() for name in floor)
    assert drawn == sorted({domain(path) for path in modules()} - {"__init__"})


def test_imports_downward_and_narrow() -> None:
    for path in modules():
        if domain(path) == "__init__":
            continue
        # domains above `environment` may use the public names as a user does
        public = {*PUBLIC, "__version__"} if LEVELS[domain(path)] < LEVELS["environment"] else set()
        above = {n for n in own(path) - public if LEVELS.get(n, -1) < LEVELS[domain(path)]}
        assert above == set(), f"{named(path)} imports from above"
        assert own(path) <= NARROW.get(domain(path), own(path)), f"{named(path)}: {own(path)}"


def round_about(below: dict[str, set[str]]) -> set[str]:
    """Names that import one another in a circle, or that import such names."""
    left = dict(below)
    while free := [name for name, needed in left.items() if not needed & left.keys()]:
        for name in free:
            del left[name]
    return set(left)


def test_imports_acyclic() -> None:
    """Also within one floor, and also in imports for the type checker only."""
    domains: dict[str, set[str]] = {}
    for path in modules():
        domains.setdefault(domain(path), set()).update(own(path) & set(LEVELS))
    assert round_about(domains) == set()
    paths = {dotted(path): path for path in modules()}
    below = {
        name: {one if one in paths else one.rpartition(".")[0] for one in imported(path)} - {name}
        for name, path in paths.items()
    }
    assert round_about(below) == set()
    assert round_about({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"numpy"}}) == {"a", "b", "c"}


def dotted(path: Path) -> str:
    """Name by which a source is imported."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_imports_kernels_cli_benchmarks_separate() -> None:
    """Kernels import numpy, numba with llvmlite, and their own folder; only cli/ draws."""
    benchmarks = {path.stem for path in (ROOT / "benchmarks").iterdir()} - {"__pycache__"}
    for path in modules():
        names = imported(path)
        words = {name.split(".")[0] for name in names}
        assert not words & benchmarks, named(path)
        if domain(path) not in {"cli", "__main__"}:
            assert not words & {"rich", "typer", "click"}, named(path)
        if domain(path) == "kernels":
            theirs = words - sys.stdlib_module_names - {"numpy", "numba", "llvmlite"}
            assert theirs <= {"hapticdb"}, named(path)  # of which `NARROW` allows nothing else
            assert "hapticdb" not in names, named(path)


def run_python(script: str, *arguments: str, **variables: str) -> str:
    return finished(
        [sys.executable, "-c", script, *arguments],
        check=True,
        env={k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | variables,
    ).stdout


# --- texts --------------------------------------------------------------------------------------


def committed_texts() -> Iterator[tuple[str, str]]:
    """Name and text of each text file that git has or would add."""
    paths: list[Path] = []
    if shutil.which("git") and (ROOT / ".git").exists():
        listing = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        asked = finished(listing, cwd=ROOT, check=True)
        paths = [ROOT / name for name in asked.stdout.split("\0") if name]
    else:  # a source distribution
        folders = ("src", "tests", "benchmarks", "examples", "docs", "requirements")
        paths = [p for folder in folders for p in (ROOT / folder).rglob("*")]
        paths += ROOT.glob("*.*")
    for path in paths:
        if path.is_file() and "__pycache__" not in path.parts:
            content = path.read_bytes()
            if b"\0" not in content:
                yield named(path), content.decode("utf-8", "replace")


def test_texts_no_machine_path_or_index() -> None:
    place = re.compile(r"(?<![\w.~$}/])/(?:work|root|home|Users)/")
    # written so that the pattern does not match this file
    index = re.compile(r"pypi\.(org|python)|files\.pythonhosted|-index-ur[l]|-find-link[s]")
    found = [
        f"{name}: {match.group()}"
        for name, text in committed_texts()
        for pattern in (place, index)
        if (match := pattern.search(text))
    ]
    assert found == []


# --- waits in tests ------------------------------------------------------------------------------

# methods that may wait for ever without arguments; tables have the same name
WAITS = {"acquire", "communicate", "get", "join", "recv", "result", "wait"}
WAITS_OF_OTHERS = {("table", "join")}
RUNS = {"run", "call", "check_call", "check_output"}


def endless_waits(source: ast.Module, *, is_test: bool) -> Iterator[tuple[int, str]]:
    """Line number and text of each call and loop of a source that may wait for ever.

    Tests start processes only through the module `children`; benchmarks always give a timeout.
    """
    for node in ast.walk(source):
        if isinstance(node, ast.While) and _sleeps(node) and not _looks_at_clock(node):
            yield node.lineno, f"while {ast.unparse(node.test)}"
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        name, owner = node.func.attr, ast.unparse(node.func.value)
        is_limited = any(keyword.arg == "timeout" for keyword in node.keywords)
        bare = not node.args and not node.keywords
        starts = owner == "subprocess" and (name in RUNS or (name == "Popen" and is_test))
        waits = name in WAITS and bare and (owner.split(".")[-1], name) not in WAITS_OF_OTHERS
        if waits or (starts and (is_test or not is_limited)) or (owner, name) == ("os", "waitpid"):
            yield node.lineno, ast.unparse(node)


def _sleeps(loop: ast.While) -> bool:
    calls = [node.func for node in ast.walk(loop) if isinstance(node, ast.Call)]
    return any(isinstance(call, ast.Attribute) and call.attr == "sleep" for call in calls)


def _looks_at_clock(loop: ast.While) -> bool:
    return any(
        isinstance(node, ast.Attribute) and node.attr == "monotonic" for node in ast.walk(loop)
    )


def test_waits_have_time_limit() -> None:
    """A wait without an end would let a failing test hang the run."""
    # the last three wait in something that another part ends: processes of a session, a fake's
    # thread; the servers' programs have a limit of their own
    allowed = [
        "tests/children.py",
        "tests/postgres_servers.py",
        "tests/session/processes/workers.py",
        "tests/viser_page.py",
        "tests/devices/fake_hd.py",
    ]
    found: list[str] = []
    for path in python_files():
        folder = named(path).split("/")[0]
        if folder in {"tests", "benchmarks"} and named(path) not in allowed:
            waits = endless_waits(tree(path), is_test=folder == "tests")
            found += [f"{named(path)}:{line}: {text}" for line, text in waits]
    assert found == []


# --- public names -------------------------------------------------------------------------------


def test_public_names() -> None:
    assert sorted(PUBLIC) == PUBLIC
    for name in PUBLIC:
        assert inspect.getdoc(getattr(hapticdb, name)), f"{name} has no docstring"


def test_version_of_changelog_and_citation() -> None:
    newest = re.search(r"^## \[(.+)\] - ", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None
    assert newest[1] == hapticdb.__version__
    assert f"\nversion: {newest[1]}\n" in (ROOT / "CITATION.cff").read_text()


# --- the kernels' cache -------------------------------------------------------------------------


def test_sources_digest_changes_with_any_edit(tmp_path: Path) -> None:
    """Also an edit of a leaf in another file than its entry's, with equal size and time stamp."""
    folder = tmp_path / "kernels"
    shutil.copytree(PACKAGE / "kernels", folder, ignore=shutil.ignore_patterns("__pycache__"))
    first = sources_digest(folder)
    assert first == sources_digest(PACKAGE / "kernels")
    for source in sorted(folder.rglob("*.py")):
        content, status = source.read_bytes(), source.stat()
        source.write_bytes(content[:-1] + b" ")
        os.utime(source, ns=(status.st_atime_ns, status.st_mtime_ns))
        assert sources_digest(folder) != first, source.name
        source.write_bytes(content)
        assert sources_digest(folder) == first
    (folder / "curves.py").rename(folder / "bends.py")
    assert sources_digest(folder) != first

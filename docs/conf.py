"""The site: all pages, and the API from the docstrings. `make site` writes it to build/site."""

import builtins
import inspect
import re
import shutil
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy.typing as npt
from pygments.lexers import PostgresLexer
from sphinx.application import Sphinx
from sphinx.domains.python import ObjectEntry, PythonDomain
from sphinx.environment import BuildEnvironment
from sphinx.ext.napoleon import Config, NumpyDocstring
from sphinx.highlighting import lexers
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.logging import getLogger
from sphinx.util.typing import stringify_annotation

Item = TypeVar("Item")


class ArrayLike:
    """Stand-in for numpy's union of eight types: signatures show its name."""


class NDArray(Generic[Item]):
    """Likewise."""


for stand_in in (ArrayLike, NDArray):
    stand_in.__module__ = "numpy.typing"
    setattr(npt, stand_in.__name__, stand_in)

import hapticdb  # noqa: E402 - after the stand-ins, for its annotations

project = "hapticdb"
author = copyright = "The hapticdb developers"  # noqa: A001 - Sphinx's name
version = release = hapticdb.__version__
html_title = f"hapticdb {release}"

root_doc = "README"
include_patterns = ["*.md", "docs/**.md", "docs/**.rst"]
exclude_patterns = [".*", "benchmarks", "build", "src", "tests"]  # not walked through
extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_heading_anchors = 4
lexers["sql"] = PostgresLexer()  # knows $1

html_theme = "furo"
html_copy_source = False

default_role = "py:obj"
nitpicky = True  # each type of ours in a signature is on a page, but for these:
INTERNAL = [
    "clashes.rules.Rules", "kernels.hand.device_spring.DeviceSpring",
    "machines.machine.LinkSurface", "pointshell.coverage.Ball", "pointshell.orientation.Surface",
    "store.base.Store", "store.finding.HasObjects", "store.pairs.StoredPairs",
]  # fmt: skip
nitpick_ignore = [("py:class", f"hapticdb.{name}") for name in INTERNAL]
nitpick_ignore_regex = [("py:obj", ".*"), ("py:.*", r"(?!hapticdb\.).*")]
autodoc_default_options = {"inherited-members": "tuple, str"}
autodoc_member_order = "bysource"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88

CONSTRUCTED = {
    "hapticdb.Coupling", "hapticdb.DistanceField", "hapticdb.Grid", "hapticdb.GridOptions",
    "hapticdb.Handle", "hapticdb.ImportOptions", "hapticdb.PointShell", "hapticdb.Recording",
    "hapticdb.ResidentCells", "hapticdb.Session", "hapticdb.TangentPlane",
}  # fmt: skip
"""Classes for callers to make; of the others the fields are shown, and no constructor."""
NAME = r"\w+(?: \([^)]*\)(?: \w+)?)?"
ITEM = rf"{NAME}(?:, {NAME})* : "
"""Begin of an item of a docstring: names, with or without shapes, before a colon."""


def items(block: str) -> Iterator[tuple[str, str, str]]:
    """Names, shape and text of each item of a paragraph, ``a : text; b, c (3,) : text``."""
    text = re.sub(rf"\n(?!{ITEM})\s*", " ", block)
    for item in re.split(rf"(?:; |(?<=\.) |;?\n)(?={ITEM})", text):
        names, _, said = item.partition(" : ")
        shape = "".join(re.findall(r" (\([^)]*\)(?: \w+)?)$", names))
        yield names.removesuffix(shape).rstrip(), shape, said


def numpy_style(lines: list[str], heading: str) -> list[str]:
    """Docstring with its paragraphs of items, up to the first section, as numpy's sections."""
    end = next((n - 1 for n, line in enumerate(lines) if set(line) == {"-"}), len(lines))
    found: list[str] = []
    for block in "\n".join(lines[:end]).split("\n\n"):
        if re.match(ITEM, block):
            found += [heading, "-" * len(heading)]
            for names, shape, text in items(block):
                found += [f"{names} : {shape}" if shape else names, f"    {text}"]
            found += ["", ""]
        else:
            found += [*block.split("\n"), ""]
    return [*found, *lines[end:]]


def typed(names: list[str], hints: dict[str, Any]) -> list[str]:
    """Directive of a field, or of several with one description, by the type of its annotation."""
    types = {stringify_annotation(hints[name], "smart") for name in names if name in hints}
    one = [f"   :type: {types.pop()}"] if len(types) == 1 else []
    return [".. attribute:: " + "\n   ".join(names), *one, ""]


class Docstring(NumpyDocstring):
    """Docstring in numpy's style; fields have their annotations, and shapes in their texts."""

    def _parse_attributes_section(self, section: str) -> list[str]:
        del section
        hints = inspect.get_annotations(self._obj) if isinstance(self._obj, type) else {}
        lines: list[str] = []
        for names, kind, text in self._consume_fields():
            shape = [f"{kind}:"] if kind.startswith("(") else []
            lines += [*typed(names.split(", "), hints), *self._indent([*shape, *text], 3), ""]
        return "\n".join(lines).split("\n")


def undescribed(obj: Any, text: str) -> list[str]:
    """Directives of the fields of a dataclass or NamedTuple without a description."""
    if not (is_dataclass(obj) or issubclass(obj, tuple)):
        return []
    described = ModuleAnalyzer.for_module(obj.__module__).find_attr_docs()
    hints = inspect.get_annotations(obj)
    fields = [
        typed([name], hints)
        for name in hints
        if not name.startswith("_")
        and (obj.__name__, name) not in described
        and not re.search(rf"^(\.\. attribute::|  ) {name}$", text, re.MULTILINE)
    ]
    return [line for field in fields for line in field]


def render(app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]) -> None:
    """Turn a docstring into reStructuredText, in place."""
    del options
    has_fields = what == "class" and (name not in CONSTRUCTED or is_dataclass(obj))
    heading = "Attributes" if has_fields else "Parameters"
    given = numpy_style(lines, heading) if what in {"class", "function", "method"} else lines
    config = Config(napoleon_use_param=False, napoleon_use_rtype=False)
    # as an object: of an attribute napoleon takes the text before a colon for its type
    lines[:] = Docstring(given, config, app, "object", name, obj).lines()
    if what == "class" and name not in CONSTRUCTED:
        lines += ["", *undescribed(obj, "\n".join(lines))]


def signature(
    app: Sphinx, what: str, name: str, obj: object, options: object, text: str | None, result: str
) -> tuple[str | None, str]:
    """Hide the constructor of a class made by the library alone."""
    del app, obj, options
    if what == "class" and name not in CONSTRUCTED:
        return "", ""
    return text and text.replace("<factory>", "..."), result  # else it is not parsed


def skip(app: Sphinx, what: str, name: str, obj: object, *_: object) -> bool | None:
    """Leave out the members of a NamedTuple's fields, which are in its docstring."""
    del app, what, name
    return True if str(obj.__doc__).startswith("Alias for field number") else None


class Names(PythonDomain):
    """Names of Python's own lead nowhere: else the type `bytes` leads to a field `bytes`."""

    def find_obj(
        self, env: BuildEnvironment, module: str, owner: str, name: str, *rest: Any
    ) -> list[tuple[str, ObjectEntry]]:
        """Find the objects that a name may mean, those of `hapticdb.errors` last."""
        if hasattr(builtins, name):
            return []
        found = super().find_obj(env, module, owner, name, *rest)
        return found or super().find_obj(env, "hapticdb.errors", "", name, *rest)


def check_names(app: Sphinx, env: BuildEnvironment) -> None:
    """Warn of public names without a place in the reference."""
    del app
    for name in hapticdb.__all__:
        if f"hapticdb.{name}" not in env.domains.python_domain.objects:
            getLogger(__name__).warning("hapticdb.%s is in no page below docs/api", name)


def with_contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Give the start page the list of all pages, by readers, from its own first paragraph."""
    del app
    if page != root_doc:
        return
    text = source[0].replace("](docs/decisions)", "](docs/decisions.rst)")
    first, last = text.split("\n\n")[1], text.rsplit("\n\n", 1)[-1]
    parts = [("Start", first.split("\n")[0]), *re.findall(r"^(\w+): (.*)", first, re.MULTILINE)]
    parts += [("API", "[Reference](docs/api/index.rst)"), ("Project", last)]
    for caption, links in parts:
        pages = re.findall(r"\[(\w)([^\]]*)\]\(([^)]+)\)", links)
        entries = "\n".join(f"{title.upper()}{rest} <{path}>" for title, rest, path in pages)
        text += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{entries}\n```\n"
    source[0] = text


def add_index(app: Sphinx, error: Exception | None) -> None:
    """Copy the start page to the name that web servers show first."""
    if error is None:
        shutil.copy(Path(app.outdir, f"{root_doc}.html"), Path(app.outdir, "index.html"))


def setup(app: Sphinx) -> None:
    """Connect the functions above."""
    app.add_domain(Names, override=True)
    app.connect("autodoc-process-docstring", render)
    app.connect("autodoc-process-signature", signature)
    app.connect("autodoc-skip-member", skip)
    app.connect("env-check-consistency", check_names)
    app.connect("source-read", with_contents)
    app.connect("build-finished", add_index)

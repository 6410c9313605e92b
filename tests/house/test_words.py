"""Docstrings name things by nouns: few relative clauses and few vague verbs, by room."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from sources import PACKAGE, modules, tree

CLAUSE = re.compile(r"\b(?:that|which|what|where|whose|whoever|whatever)\b", re.IGNORECASE)
VAGUE = re.compile(
    r"\b(?:ask|asked|asks|beside|felt|found|held|kept|known|left|look|looked|looking|looks|met|said"
    r"|taken|tell|tells|told|want|wanted|wants|wish\w*)\b",
    re.IGNORECASE,
)
CODE = re.compile(r"`+[^`]*`+|\b\w*_\w+|(?:\b\w+, )*\b\w+(?= : )|\b\w+(?= \([\w-]+,[\w, -]*\))")
"""Names of code in a docstring: in backquotes, with underscores, before a colon or a shape."""
MOST_CLAUSES, MOST_VAGUE = 2.0, 4.0
"""Most relative clauses in 100 words, and vague verbs in 1,000, of a room."""
LEAST_WORDS = 150
"""Words from which on a room is judged."""


def prose_of(source: ast.Module) -> Iterator[str]:
    """Docstrings of a module, and the strings behind its constants, without names of code."""
    for node in ast.walk(source):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            is_function = not isinstance(node, ast.Module | ast.ClassDef)
            for one in node.body[: 1 if is_function else None]:
                if isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant):
                    yield CODE.sub("", str(one.value.value))


def room_of(path: Path) -> str:
    """Folder of a module below the package; kernels are judged folder by folder."""
    folders = path.relative_to(PACKAGE).parts[:-1]
    return "/".join(folders[: 2 if folders[:1] == ("kernels",) else 1]) or "(root)"


def test_words_clauses_and_vague_verbs_by_room() -> None:
    texts: dict[str, list[str]] = defaultdict(list)
    for path in modules():
        texts[room_of(path)] += prose_of(tree(path))
    over = {}
    for room, some in texts.items():
        whole = " ".join(some)
        n_words = len(whole.split())
        clauses = 100.0 * len(CLAUSE.findall(whole)) / max(n_words, 1)
        vague = 1000.0 * len(VAGUE.findall(whole)) / max(n_words, 1)
        if n_words > LEAST_WORDS and (clauses > MOST_CLAUSES or vague > MOST_VAGUE):
            over[room] = f"{clauses:.1f} clauses in 100 words, {vague:.1f} vague verbs in 1,000"
    assert not over

"""Check docstrings and names against the rules of CONTRIBUTING.md, "Words".

ruff checks the first line of functions (D400, D401). This checks the openings of modules, classes,
attributes and properties, turns of talk, functions that are named by a participle, and words that
the glossary has replaced.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("devices", "foottile", "service", "storage", "studies")

OPENING = re.compile(
    r"(What|Who|Whose|Whether|Which|Is|Are|Has|Have|Does|Do|May|Can|Of|It|They|Those|One of|As|"
    r"All that|Likewise|The same)\b"
)
TALK = re.compile(
    r"\b(that which|those (that|who|which)|nobody|somebody|whoever|whichever|"
    r"in which case it|what (is|was|has|it|they)|who (has|have|is|are|may))\b",
    re.IGNORECASE,
)
PARTICIPLE = re.compile(
    r"_*(\w*[a-z]{2}ed|begun|known|taken|told|given|shown|borne|chosen|felt|gone|heard|held|kept|"
    r"said|understood|unseen|spoken)"
)
VERBS = frozenset({"exceed", "feed", "need", "pipelined", "proceed", "read", "seed"})
"""Verbs that end as a participle, and a schedule's name."""
FORBIDDEN = frozenset(
    {"asked", "doom", "heard", "ladder", "mill", "owed", "rung", "said", "told", "trouble"}
)
"""Words of names that have a term in docs/glossary.md: `revision`, `requested`, `model_set` ..."""


def main() -> int:
    """Print each violation; return 1 if there is one."""
    found = 0
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            for line, message in check(ast.parse(path.read_text("utf-8"))):
                found += 1
                print(f"{path.relative_to(ROOT)}:{line}: {message}")
    return 1 if found else 0


def check(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and message of each violation in a module."""
    for line, text in docstrings(tree):
        if opening := OPENING.match(text):
            yield line, f"docstring opens with {opening[0]!r}; expected a noun or a verb"
        if talk := TALK.search(" ".join(text.split())):
            yield line, f"docstring has {talk[0]!r}; name the noun"
    for line, name, is_function in names(tree):
        if is_function and PARTICIPLE.fullmatch(name) and name.strip("_") not in VERBS:
            yield line, f"function {name} is named by a participle; expected a verb and its object"
        if words := FORBIDDEN & set(name.lower().removesuffix("s").split("_")):
            yield line, f"{name} has {min(words)!r}; see docs/glossary.md"


def names(tree: ast.Module) -> Iterator[tuple[int, str, bool]]:
    """Yield line and name of what a module defines; True: a function, not a property."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                yield node.lineno, node.name, not node.decorator_list and "_" not in node.name[1:]
            case ast.ClassDef():
                yield node.lineno, node.name, False
            case ast.arg():
                yield node.lineno, node.arg, False
            case ast.Name(ctx=ast.Store()):
                yield node.lineno, node.id, False


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and text of each docstring, also of attributes and constants."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for each in node.body[:1] if is_function else node.body:
            match each:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    yield each.lineno, text.strip()


if __name__ == "__main__":
    sys.exit(main())

"""Check docstrings against the rules of CONTRIBUTING.md, "Words".

ruff checks the first line of functions (D400, D401). This checks the openings of modules, classes,
attributes and properties, and turns of talk.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("devices", "foottile", "service", "storage")

OPENING = re.compile(
    r"(What|Who|Whose|Whether|Which|Is|Are|Has|Have|Does|Do|May|Can|Of|It|They|Those|One of|As|"
    r"All that|Likewise|The same)\b"
)
TALK = re.compile(
    r"\b(that which|those (that|who|which)|nobody|somebody|whoever|whichever|"
    r"in which case it|what (is|was|has|it|they)|who (has|have|is|are|may))\b",
    re.IGNORECASE,
)


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

"""Words that can be shown, wherever they come from: names of files, contents, other people."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""One line that a terminal shows and does not obey, and that UTF-8 can carry.

    A byte of a file's name that is no UTF-8 is a lone surrogate in Python: it is shown as `\udcff`.
    """
    line = " ".join(text.split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)

"""Words that can be shown, wherever they come from: names of files, contents, other people."""

from __future__ import annotations


def is_utf8(text: str) -> bool:
    """Is it text that JSON, Arrow and a network can carry? The names of some files are not."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def printable(text: str, *, keeps_lines: bool = False) -> str:
    r"""Return text that a terminal shows and does not obey, and that UTF-8 can carry.

    Whatever is not printable is shown as an escape: `\x1b`, `\u202e`. A byte of a file's name that
    is no UTF-8 is a lone surrogate in Python: it is shown as `\udcff`.

    Args:
        text: from anywhere.
        keeps_lines: line breaks, tabs and runs of spaces stay; else it becomes one line.
    """
    if not keeps_lines:
        text = " ".join(text.split())
    elif text.isascii() and text.replace("\n", "").isprintable():
        return text
    kept = "\n\t" if keeps_lines else ""
    return "".join(
        c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text
    )

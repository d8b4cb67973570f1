"""Escaping of untrusted text (file names, file contents, network) for terminals and logs."""

from __future__ import annotations


def is_utf8_encodable(text: str) -> bool:
    """Return whether a text can be encoded as UTF-8. The names of some files cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def escape_control_chars(text: str, *, keep_line_breaks: bool = False) -> str:
    r"""Escape control characters, so that a terminal prints the text and UTF-8 can encode it.

    Unprintable characters become escapes: `\x1b`, `\u202e`. A byte of a file name that is not UTF-8
    is a lone surrogate in Python: it becomes `\udcff`.

    Args:
        text: untrusted text.
        keep_line_breaks: keep line breaks, tabs and runs of spaces; else join all to one line.
    """
    if not keep_line_breaks:
        text = " ".join(text.split())
    elif text.isascii() and text.replace("\n", "").isprintable():
        return text
    kept = "\n\t" if keep_line_breaks else ""
    return "".join(
        c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text
    )

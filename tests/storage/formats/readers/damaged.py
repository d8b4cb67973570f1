"""Texts of programs, damaged in ways that copying, cutting and editing damage them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from devices.errors import FileFormatError, UsageError
from storage.formats.reference import ReferenceOptions, read_reference


def damaged_texts(text: str) -> Iterator[str]:
    """Yield a text cut at each line and within it, without each line, and with broken cells."""
    lines = text.splitlines(keepends=True)
    for i, line in enumerate(lines):
        yield "".join(lines[:i])
        yield "".join(lines[:i]) + line[: len(line) // 2]
        yield "".join(lines[:i] + lines[i + 1 :])
        yield "".join([*lines[:i], "\n", *lines[i:]])
        for mark in ("\t", ",", ";"):
            cells = line.split(mark)
            yield "".join([*lines[:i], mark.join(reversed(cells)), *lines[i + 1 :]])
            yield "".join([*lines[:i], mark.join([*cells, "x\n"]), *lines[i + 1 :]])
            yield "".join([*lines[:i], mark.join(cells[:-2]), "\n", *lines[i + 1 :]])
            yield "".join([*lines[:i], line.replace("1", "²").replace("0", ""), *lines[i + 1 :]])
    yield text.replace("\n", "")
    yield text.replace("\t", "").replace(",", "").replace(";", "")


def count_refused(path: Path, text: str, stated: ReferenceOptions) -> int:
    """Read all damaged texts; each is read, or refused by one of our own errors."""
    refused = 0
    for damaged in damaged_texts(text):
        path.write_text(damaged, encoding="utf-8")
        try:
            read_reference(path, stated)
        except (FileFormatError, UsageError):
            refused += 1
    return refused

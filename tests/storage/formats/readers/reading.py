"""References read from files that a test writes, held against numbers; and damaged texts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError, UsageError
from storage.formats.reference import ReferenceData, ReferenceOptions, read_reference
from tests.builders.c3d import c3d_bytes


def read(
    folder: Path,
    content: str | bytes,
    stated: ReferenceOptions | None = None,
    name: str = "trial.txt",
) -> ReferenceData:
    """Read this content of a file."""
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_reference(path, stated or ReferenceOptions())


def read_c3d(
    folder: Path,
    content: dict[str, dict[str, Any]],
    analog: Floats,
    stated: ReferenceOptions | None = None,
    **more: Any,
) -> ReferenceData:
    """Read a C3D file of these parameters and channels."""
    return read(folder, c3d_bytes(content, analog, **more), stated, "gait.c3d")


def check(found: object, *, rtol: float = 0.0, atol: float = 0.0, **expected: Any) -> None:
    """Numbers of a reference or a load are these: to the last bit, or within the tolerance."""
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(found, name), values, rtol, atol, err_msg=name)


def damaged_texts(text: str) -> Iterator[str]:
    """Yield a text cut at lines and within them, without a line, and with broken cells."""
    lines = text.splitlines(keepends=True)
    for i in range(0, len(lines), 1 + len(lines) // 20):
        line = lines[i]
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


def count_refused(folder: Path, text: str, stated: ReferenceOptions | None = None) -> int:
    """Read all damaged texts; each is read, or refused by one of our own errors."""
    refused = 0
    for damaged in damaged_texts(text):
        try:
            read(folder, damaged, stated)
        except (FileFormatError, UsageError):
            refused += 1
    return refused

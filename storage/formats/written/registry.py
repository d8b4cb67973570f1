"""Registry of all export formats; a new format is a module and a line here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import AfterValidator, WithJsonSchema

from devices.errors import UsageError
from storage.formats.written.arrow import ARROW
from storage.formats.written.c3d import C3D
from storage.formats.written.csv_text import CSV
from storage.formats.written.format import Format
from storage.formats.written.matlab.file import MATLAB
from storage.formats.written.mcap.file import MCAP
from storage.formats.written.opensim.file import OPENSIM
from storage.formats.written.parquet import PARQUET
from storage.formats.written.xdf import XDF

FORMATS: Mapping[str, Format] = {
    known.name: known
    for known in (
        PARQUET,
        ARROW,
        CSV,
        C3D,
        OPENSIM,
        MCAP,
        MATLAB,
        XDF,
    )
}


SEVERAL = tuple(known.name for known in FORMATS.values() if known.holds_several)
"""Names of the formats that hold several sessions in one file."""


def format_named(name: str) -> Format:
    """Return the format of this name.

    Raises:
        UsageError: no format has this name.
    """
    if name not in FORMATS:
        raise UsageError(f"no format {name[:80]!r}", expected="one of " + ", ".join(FORMATS))
    return FORMATS[name]


def together_named(name: str) -> Format:
    """Return the format of this name, which holds several sessions in one file.

    Raises:
        UsageError: no format has this name, or it holds one session only.
    """
    found = format_named(name)
    if not found.holds_several:
        raise UsageError(
            f"{name} holds one session only",
            expected="one of " + ", ".join(SEVERAL),
            remedy="Or ask for each session by itself",
        )
    return found


def _known(name: str) -> str:
    if name not in FORMATS:
        raise ValueError("should be one of " + ", ".join(FORMATS))
    return name


FormatName = Annotated[
    str, AfterValidator(_known), WithJsonSchema({"type": "string", "enum": list(FORMATS)})
]
"""Type of a format's name in pydantic models."""

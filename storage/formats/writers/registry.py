"""Registry of all export formats; a new format is a module and a line here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import AfterValidator, WithJsonSchema

from devices.errors import UsageError
from storage.formats.writers.c3d import C3D
from storage.formats.writers.format import ExportFormat
from storage.formats.writers.matlab import MATLAB
from storage.formats.writers.mcap import MCAP
from storage.formats.writers.opensim import OPENSIM
from storage.formats.writers.tables import ARROW, CSV, PARQUET
from storage.formats.writers.xdf import XDF

FORMATS: Mapping[str, ExportFormat] = {
    known.name: known for known in (PARQUET, ARROW, CSV, C3D, OPENSIM, MCAP, MATLAB, XDF)
}


MULTI_SESSION_FORMATS = tuple(
    known.name for known in FORMATS.values() if known.can_hold_several_sessions
)
"""Names of the formats that hold several sessions in one file."""


def get_format(name: str) -> ExportFormat:
    """Return the format of this name.

    Raises:
        UsageError: no format has this name.
    """
    if name not in FORMATS:
        raise UsageError(f"no format {name[:80]!r}", expected="one of " + ", ".join(FORMATS))
    return FORMATS[name]


def get_multi_session_format(name: str) -> ExportFormat:
    """Return the format of this name, which holds several sessions in one file.

    Raises:
        UsageError: no format has this name, or it holds one session only.
    """
    found = get_format(name)
    if not found.can_hold_several_sessions:
        raise UsageError(
            f"{name} holds one session only",
            expected="one of " + ", ".join(MULTI_SESSION_FORMATS),
            remedy="Or ask for each session by itself",
        )
    return found


def _check_format_name(name: str) -> str:
    if name not in FORMATS:
        raise ValueError("should be one of " + ", ".join(FORMATS))
    return name


FormatName = Annotated[
    str,
    AfterValidator(_check_format_name),
    WithJsonSchema({"type": "string", "enum": list(FORMATS)}),
]
"""Type of a format's name in pydantic models."""

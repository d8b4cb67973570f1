"""User's options for the layout of a text of columns."""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass

from devices.errors import UsageError

DECIMAL_PATTERNS = {
    ",": re.compile(r"[+-]?([1-9]\d{0,2}(\.\d{3})+|\d*)(,\d*)?([eE][+-]?\d+)?"),
    ".": re.compile(r"[+-]?([1-9]\d{0,2}(,\d{3})+|\d*)(\.\d*)?([eE][+-]?\d+)?"),
}
"""Patterns of numbers by decimal mark; the other mark may separate thousands."""


@dataclass(frozen=True)
class TextOptions:
    """Layout of a text as stated by the user; None: detected.

    Attributes:
        skip_rows: number of lines above the line of names, or above the numbers without names.
        units_row: number of the line of units; the first line of the file is 1.
        decimal: decimal mark, "," or "."; the other mark may separate thousands.
        encoding: Python's name of the encoding.
    """

    skip_rows: int | None = None
    units_row: int | None = None
    decimal: str | None = None
    encoding: str | None = None

    def __post_init__(self) -> None:
        for option, value, least in (
            ("--skip-rows", self.skip_rows, 0),
            ("--units-row", self.units_row, 1),
        ):
            if value is not None and value < least:
                raise UsageError(f"{option} {value}", expected=f"a whole number from {least} on")
        if self.decimal is not None and self.decimal not in DECIMAL_PATTERNS:
            raise UsageError(f"--decimal {self.decimal!r}", expected="a comma, or a point")
        if self.encoding is not None:
            try:
                "".encode(self.encoding)
                codecs.lookup(self.encoding)
            except (LookupError, ValueError) as error:
                raise UsageError(
                    f"--encoding {self.encoding!r}", expected="a name such as utf-8, cp1252, cp932"
                ) from error

    @property
    def has_layout_option(self) -> bool:
        """True if an option other than the encoding is set; the head is then not inspected."""
        return any(one is not None for one in (self.skip_rows, self.units_row, self.decimal))

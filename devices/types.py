"""Validated field types of pydantic models: bounded numbers and printable texts.

Values come from scene files, chips, stored files and the network. They are validated at the input,
so that later code may rely on the bounds.
"""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

T_NS_END = 7_258_118_400_000_000_000
"""Upper bound of UTC: 1 January 2200. The lower bound is 1970."""
T_MONO_NS_END = 2**60
"""Upper bound of CLOCK_MONOTONIC, 36 years; sums and differences with `T_NS_END` fit 64 bits."""
OFFSET_NS_END = T_MONO_NS_END + T_NS_END
"""Upper bound of the difference of two instants."""
SEQ_END = 2**53
"""Upper bound of frame numbers; below it JSON numbers are exact, in browsers too (RFC 8259)."""
TILES_MAX = 64
"""Eight multiplexers of eight channels."""
MODELS_MAX = 64
RATE_HZ_MIN = 1e-3
"""Lowest frame rate: a frame in a quarter of an hour."""


_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters except line break and tab, and lone surrogates, which UTF-8 cannot encode."""


def check_text(text: str) -> str:
    """Check that a text has no control character except line break and tab, and return it.

    Raises:
        ValueError: it has one, which could forge a line of a log.
    """
    if found := _CONTROL.search(text):
        raise ValueError(f"has the control character U+{ord(found[0]):04X}")
    return text


_MISLEADING = re.compile("[\u202a-\u202e\u2066-\u2069\ufeff\ufffe\uffff]")
"""Bidirectional overrides, byte order marks and noncharacters.

Joiners and other zero-width marks are allowed: Persian, Hindi and emoji need them.
"""


def check_user_text(text: str) -> str:
    """Check a text that a user sets, and return it.

    Stricter than for texts that programs send or store.

    Raises:
        ValueError: it has an invisible or misleading character.
    """
    if found := _MISLEADING.search(text):
        raise ValueError(f"has the character U+{ord(found[0]):04X}, which cannot be seen")
    return check_text(text)


def check_user_name(text: str) -> str:
    """Check a name that a user sets, and return it: one line, else as for `check_user_text`.

    Raises:
        ValueError: it is not such a name.
    """
    return check_user_text(_check_one_line(text))


def _check_one_line(text: str) -> str:
    if "\n" in text or "\t" in text:
        raise ValueError("has a line break or tab in it")
    return check_text(text)


Identifier = Annotated[str, Field(max_length=200), AfterValidator(_check_one_line)]
"""Name: one line without control characters."""
Text = Annotated[str, Field(max_length=10_000), AfterValidator(check_text)]
"""Text for people, of one or more lines."""
Metres = Annotated[float, Field(ge=-10.0, le=10.0)]
UInt16 = Annotated[int, Field(ge=0, le=0xFFFF)]
Count = Annotated[int, Field(ge=0, lt=SEQ_END)]
Seq = Annotated[int, Field(ge=0, lt=SEQ_END)]
"""Frame number in a stream."""
TNs = Annotated[int, Field(ge=0, lt=T_NS_END)]
"""UTC in ns since 1970."""
TMonoNs = Annotated[int, Field(gt=-T_MONO_NS_END, lt=T_MONO_NS_END)]
"""CLOCK_MONOTONIC in ns."""
OffsetNs = Annotated[int, Field(gt=-OFFSET_NS_END, lt=OFFSET_NS_END)]
"""Difference of two instants."""


class StrictModel(BaseModel):
    """Base class of strict models: frozen, no unknown keys, no NaN or infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

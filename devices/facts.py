"""What the facts about a node are made of: numbers within reason, and texts that can be shown.

They come from scene files, from chips, from files and from the network. What breaks these bounds is
refused where it comes in, so that no reader has to think of it.
"""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

T_NS_END = 7_258_118_400_000_000_000
"""1 January 2200: no frame is taken then. The first instant is in 1970, where clocks begin."""
T_MONO_NS_END = 2**60
"""36 years since a machine was started; sums and differences with `T_NS_END` fit 64 bits."""
OFFSET_NS_END = T_MONO_NS_END + T_NS_END
"""No two instants are further apart."""
SEQ_END = 2**53
"""No stream has so many frames; below it every reader of JSON is exact, browsers too (RFC 8259)."""
TILES_MAX = 64
"""Eight multiplexers of eight channels."""
MODELS_MAX = 64
RATE_HZ_MIN = 1e-3
"""A frame in a quarter of an hour."""


_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters but line break and tab, and halves of surrogate pairs, which UTF-8 lacks."""


def can_be_shown(text: str) -> str:
    """The text, if it has no control character but line break and tab.

    Raises:
        ValueError: it has one: in a log that would be a line of its own, or worse.
    """
    if found := _CONTROL.search(text):
        raise ValueError(f"has the control character U+{ord(found[0]):04X}")
    return text


_MISLEADING = re.compile("[\u202a-\u202e\u2066-\u2069\ufeff\ufffe\uffff]")
"""Overrides of the direction of writing, byte order marks, no characters.

Joiners and other marks without width stay: Persian, Hindi and emoji are written with them.
"""


def check_new_text(text: str) -> str:
    """Return a text that somebody sets; files of older versions may hold others.

    Raises:
        ValueError: it has a character that a reader does not see, or that makes it look like
            another text.
    """
    if found := _MISLEADING.search(text):
        raise ValueError(f"has the character U+{ord(found[0]):04X}, which cannot be seen")
    return can_be_shown(text)


def check_new_name(text: str) -> str:
    """Return a name that somebody sets: one line, and a text as of `check_new_text`.

    Raises:
        ValueError: it is none.
    """
    return check_new_text(_is_one_line(text))


def _is_one_line(text: str) -> str:
    if "\n" in text or "\t" in text:
        raise ValueError("has a line break or tab in it")
    return can_be_shown(text)


Label = Annotated[str, Field(max_length=200), AfterValidator(_is_one_line)]
"""A name: one line without control characters."""
Text = Annotated[str, Field(max_length=10_000), AfterValidator(can_be_shown)]
"""Words for people."""
Metres = Annotated[float, Field(ge=-10.0, le=10.0)]
Word = Annotated[int, Field(ge=0, le=0xFFFF)]
Count = Annotated[int, Field(ge=0, lt=SEQ_END)]
Seq = Annotated[int, Field(ge=0, lt=SEQ_END)]
"""Number of a frame in its stream."""
TNs = Annotated[int, Field(ge=0, lt=T_NS_END)]
"""UTC in ns since 1970."""
TMonoNs = Annotated[int, Field(gt=-T_MONO_NS_END, lt=T_MONO_NS_END)]
"""CLOCK_MONOTONIC in ns."""
OffsetNs = Annotated[int, Field(gt=-OFFSET_NS_END, lt=OFFSET_NS_END)]
"""Difference of two instants."""


class Facts(BaseModel):
    """Base of what is said: no unknown key, no number that JSON cannot write."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

"""Slice of a session, rows by time and columns, and the options of export formats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from devices.errors import UsageError
from storage.schema import Array

SECONDS_MAX = 1e9
"""Longest time of a slice's bounds: thirty years."""


@dataclass(frozen=True)
class Slice:
    """Selection of rows and columns of a session.

    Attributes:
        start_s: first instant, in seconds after the first frame; None: the beginning.
        end_s: end, exclusive, in seconds after the first frame; None: the end of the session.
        columns: names of columns, of one tile (`force_n_0`) or of all tiles (`force_n`); empty: all
            columns.

    Raises:
        UsageError: an instant is out of range, or the end is not after the start.
    """

    start_s: float | None = None
    end_s: float | None = None
    columns: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, value in (("start", self.start_s), ("end", self.end_s)):
            if value is not None and not 0.0 <= value <= SECONDS_MAX:
                raise UsageError(
                    f"the slice's {name} is at {value:g} s",
                    expected=f"0 to {SECONDS_MAX:g} seconds after the first frame",
                )
        if self.end_s is not None and self.end_s <= (self.start_s or 0.0):
            raise UsageError(
                f"the slice ends at {self.end_s:g} s and starts at {self.start_s or 0.0:g} s",
                expected="an end after the start",
            )

    @property
    def has_all_rows_and_columns(self) -> bool:
        """True for the whole session with all columns."""
        return self == Slice()

    @property
    def has_time_bounds(self) -> bool:
        """True if the slice bounds time."""
        return self.start_s is not None or self.end_s is not None

    def compute_bounds_ns(self, begin_t_ns: int) -> tuple[int | None, int | None]:
        """Return the slice's first instant, and its end, exclusive; None: no bound.

        Args:
            begin_t_ns: instant from which seconds count, of the first frame.
        """
        start, end = (
            None if seconds is None else begin_t_ns + round(seconds * 1e9)
            for seconds in (self.start_s, self.end_s)
        )
        return start, end

    def compute_row_mask(self, t_ns: Array, begin_t_ns: int) -> Array:
        """Return the mask of the frames in the slice, bool[n].

        Args:
            t_ns: int64[n], instants of frames on the session's time axis.
            begin_t_ns: instant from which seconds count, of the first frame.
        """
        start_ns, end_ns = self.compute_bounds_ns(begin_t_ns)
        rows = np.ones(len(t_ns), dtype=np.bool_)
        if start_ns is not None:
            rows &= t_ns >= start_ns
        if end_ns is not None:
            rows &= t_ns < end_ns
        return rows


class FormatOptions(BaseModel):
    """Options of export formats. None: the format's default.

    REST and the command line offer these fields unchanged. A format refuses an option that it does
    not support (`storage.formats.writers.format.ExportFormat`).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    names: Literal["number", "serial"] | None = Field(
        default=None, description="Suffix of a tile's columns: its number, from 0, or its serial."
    )
    times: bool | None = Field(
        default=None,
        description="Columns `time_s`, seconds after the session's first frame, and `time_utc`, "
        "`t_ns` as a timestamp. Default: in every export, but not in the sealed Parquet file.",
    )
    about: bool | None = Field(
        default=None,
        description="Column `about` of CSV: its first row has the file's metadata as JSON. "
        "Default: included unless columns are chosen.",
    )
    decimal: Literal["point", "comma"] | None = Field(
        default=None, description="Decimal sign of CSV. With a comma, semicolons separate columns."
    )
    body: str | None = Field(
        default=None,
        max_length=1000,
        pattern=r"^[\w.:-]{1,100}(,[\w.:-]{1,100})*$",
        description="OpenSim: the model's body that the ground acts on, such as `calcn_r`. "
        "Default: `foot`. For several sessions, one body each, in their order: `calcn_l,calcn_r`.",
    )
    long_gap: Literal["refuse", "end"] | None = Field(
        default=None,
        description="OpenSim has no value for an unknown force. A gap too long for a straight line "
        "(50 ms, 20 ms at a begin or end of contact), or with a saturated tile: refuse the file "
        "(default), or end it before the gap.",
    )
    messages: Literal["foxglove", "ros2"] | None = Field(
        default=None,
        description="Messages of MCAP: Foxglove's, with every column of every frame, or ROS 2's.",
    )
    rate: Literal["constant"] | None = Field(
        default=None,
        description="XDF at a constant rate, for programs that require one, such as mnelab: "
        "samples are interpolated linearly between frames, and empty where frames are missing.",
    )

    @property
    def specified_names(self) -> list[str]:
        """Names of the options that are not None."""
        return [name for name, value in self if value is not None]


NO_OPTIONS = FormatOptions()

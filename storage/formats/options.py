"""What formats may be asked for besides the slice: one list, of which each takes its own."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class FormatOptions(BaseModel):
    """Options of formats. None: what the format does by itself.

    REST and the command line offer these fields as they are; a format that does not know one that
    is set refuses it (`storage.formats.written.format.Format.options`).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    names: Literal["number", "serial"] | None = Field(
        default=None,
        description="What columns of one tile end in: its number, from 0, or its serial.",
    )
    times: bool | None = Field(
        default=None,
        description="Columns `time_s`, seconds after the session's first frame, and `time_utc`, "
        "`t_ns` as a timestamp: in whatever is made, but not in the sealed Parquet file.",
    )
    about: bool | None = Field(
        default=None,
        description="Column `about` of CSV, whose first row says as JSON what the file is of; in "
        "it unless columns are chosen.",
    )
    decimal: Literal["point", "comma"] | None = Field(
        default=None,
        description="Decimal sign of CSV; with a comma, columns are parted by semicolons.",
    )
    body: str | None = Field(
        default=None,
        max_length=1000,
        pattern=r"^[\w.:-]{1,100}(,[\w.:-]{1,100})*$",
        description="OpenSim: the model's body that the ground acts on, as `calcn_r`; else `foot`. "
        "Of several sessions one for each, in their order: `calcn_l,calcn_r`.",
    )

    messages: Literal["foxglove", "ros2"] | None = Field(
        default=None,
        description="Messages of MCAP: Foxglove's, with every column of every frame, or those of "
        "ROS 2.",
    )
    rate: Literal["constant"] | None = Field(
        default=None,
        description="XDF at a constant rate, for programs that refuse instants without one, as "
        "mnelab does: samples on straight lines between frames, empty where frames are missing.",
    )

    @property
    def set_names(self) -> list[str]:
        """Names of those that are set."""
        return [name for name, value in self if value is not None]


NO_OPTIONS = FormatOptions()

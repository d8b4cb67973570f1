"""Options of export formats besides the slice: one list; each format supports a part."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class FormatOptions(BaseModel):
    """Options of export formats. None: the format's default.

    REST and the command line offer these fields unchanged. A format refuses an option that it does
    not support (`storage.formats.written.format.Format.describe_options`).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    names: Literal["number", "serial"] | None = Field(
        default=None,
        description="Suffix of a tile's columns: its number, from 0, or its serial.",
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
        default=None,
        description="Decimal sign of CSV. With a comma, semicolons separate columns.",
    )
    body: str | None = Field(
        default=None,
        max_length=1000,
        pattern=r"^[\w.:-]{1,100}(,[\w.:-]{1,100})*$",
        description="OpenSim: the model's body that the ground acts on, such as `calcn_r`. "
        "Default: `foot`. For several sessions, one body each, in their order: `calcn_l,calcn_r`.",
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

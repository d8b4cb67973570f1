"""What a session's clock table amounts to, for people and programs: JSON of `GET .../clock`."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

State = Literal["measured", "unmeasured", "unsynchronised"]


class _Fact(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StretchSummary(_Fact):
    """Measurements between which neither clock was set."""

    begin_t_ns: int | None = Field(
        description="First measurement, in the node's `t_ns`; null: that stream's UTC is unknown."
    )
    end_t_ns: int | None = Field(description="Last measurement.")
    rows: int = Field(description="Measurements in it that cannot belong to another stretch.")
    offset_ns: int = Field(description="Server's UTC minus the node's, half-way through.")
    uncertainty_ns: int = Field(description="Bound of `offset_ns`: the truth is within it.")
    drift_ppm: float | None = Field(
        description="Mean rate at which the server's clock gains on the node's; null: the rows say "
        "no more than that both are crystals."
    )
    drift_uncertainty_ppm: float | None = Field(description="Bound of `drift_ppm`.")


class StepSummary(_Fact):
    """One of the clocks was set, or stood still while its machine slept."""

    after_t_ns: int | None = Field(description="It was after this instant of the node's `t_ns`.")
    before_t_ns: int | None = Field(description="And before this one.")
    jump_ns: int = Field(description="By how much the offset changed.")
    jump_uncertainty_ns: int = Field(description="Bound of `jump_ns`.")


class StreamSummary(_Fact):
    """One stream's clock."""

    boot_id: str
    state: State = Field(
        description="unmeasured: its offset is not known; unsynchronised: nor was its clock set."
    )
    rows: int = Field(description="Measurements of the offset.")
    stretches: tuple[StretchSummary, ...]
    steps: tuple[StepSummary, ...]


class ClockSummary(_Fact):
    """How a session's clocks go against the server's."""

    streams: tuple[StreamSummary, ...]

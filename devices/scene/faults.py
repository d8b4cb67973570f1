"""Section `[[fault]]` of a scene file: what fails, when and for how long."""

from __future__ import annotations

from typing import Annotated, Literal, Self, get_args

from pydantic import Field, model_validator

from devices.scene.quantities import NotNegative, Positive, Section

TileFault = Literal["no_answer", "unplugged", "replaced", "stale", "slow", "all_ones", "over_range"]
MuxFault = Literal["brown_out", "mux_reset"]
BusFault = Literal["sda_low", "sda_high", "scl_low", "adapter_timeout", "nack_storm", "bit_errors"]
FaultKind = Literal[TileFault, MuxFault, BusFault]

RATE = 0.01
"""How often a fault strikes that comes by chance, unless a scene says otherwise."""

BUS = "bus"
"""Target of a fault that is no tile's and no multiplexer's."""


class FaultScene(Section):
    """`[[fault]]`: something fails `t_s` after the scene began, for `duration_s`.

    At `t_s` = 0 it has failed before the start.
    """

    kind: FaultKind
    tile: str | None = None
    """Which tile; for faults of a tile."""
    mux: int | None = None
    """Which multiplexer; for faults of one."""
    t_s: NotNegative
    duration_s: Positive
    rate: Annotated[float, Field(gt=0, le=1)] = RATE
    """How often, for what comes by chance: of the bytes for `nack_storm` and `bit_errors`, of the
    transfers for `adapter_timeout`."""

    @property
    def target(self) -> str:
        """What fails: a tile's serial, a mux as "0x70", or the bus."""
        return self.tile or (BUS if self.mux is None else f"0x{self.mux:02x}")

    @model_validator(mode="after")
    def _names_what_fails(self) -> Self:
        needs_tile, needs_mux = self.kind in get_args(TileFault), self.kind in get_args(MuxFault)
        if needs_tile != (self.tile is not None):
            raise ValueError(f"{self.kind} is {'' if needs_tile else 'no '}fault of a tile")
        if needs_mux != (self.mux is not None):
            raise ValueError(f"{self.kind} is {'' if needs_mux else 'no '}fault of a mux")
        return self

"""One frame while it is taken: what the transfers gave so far, and what may still be spent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from devices.clock import Clock
from devices.errors import BusFaultError
from devices.frames import NOT_READ, TileStatus

_BUS_FAULTS_MAX = 2  # each may cost the adapter's time-out, 30 ms


@dataclass
class Scan:
    """What one frame's transfers gave, one entry per tile.

    Attributes:
        padc: 0 to 1023, `NOT_READ` where not read.
        tadc: likewise.
        convert_stop_ns: CLOCK_MONOTONIC at the STOP of the CONVERT that each sample comes from.
        status: `TileStatus` bits.
        budget_ns: time left in this frame for second attempts of all tiles together.
        bus_fault: the bus itself failed, not one tile.
        reference_n: the calibration rig's force in newtons; NaN without.
    """

    padc: list[int]
    tadc: list[int]
    convert_stop_ns: list[int]
    status: list[int]
    budget_ns: int = 0
    bus_fault: bool = False
    reference_n: float = float("nan")
    reference_ns: int | None = field(default=None, repr=False)
    zeros: int = field(default=0, repr=False)
    """Tiles that read as nothing but zeros."""
    _bus_faults: int = field(default=0, repr=False)

    @classmethod
    def blank(cls, tiles: int, begin_ns: int, budget_ns: int) -> Scan:
        """A frame in which nothing has been read."""
        return cls(
            [NOT_READ] * tiles, [NOT_READ] * tiles, [begin_ns] * tiles, [0] * tiles, budget_ns
        )

    @property
    def given_up(self) -> bool:
        """The bus has failed, so the rest of the frame is not worth its time-outs."""
        return self._bus_faults >= _BUS_FAULTS_MAX

    def note_bus_fault(self, *, for_good: bool = False) -> None:
        """The bus failed once; after the second time, or at once, the frame is given up."""
        self.bus_fault = True
        self._bus_faults += _BUS_FAULTS_MAX if for_good else 1

    @contextmanager
    def second_attempt(self, clock: Clock) -> Iterator[None]:
        """Take the block's time from the budget; a fault of the bus in it ends it and is noted."""
        begin_ns = clock.now_ns()
        try:
            yield
        except BusFaultError:
            self.note_bus_fault()
        self.budget_ns -= clock.now_ns() - begin_ns

    def flag(self, tile: int, status: TileStatus | int) -> None:
        """Add to a tile's status."""
        self.status[tile] |= status

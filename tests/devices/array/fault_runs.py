"""A running stream that a fault befell, on an emulated foot, and what a witness says of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
import pytest

from devices.acquisition import Acquisition
from devices.array.startup import prepare_array
from devices.array.tile_array import TileArray
from devices.buses.i2c import open_bus
from devices.clock import UtcAnchor, VirtualClock
from devices.emulation.i2c_bus import EmulatedGpioLines
from devices.emulation.world import World
from devices.frames import FrameBatch
from devices.recovery import GpioRecovery
from devices.scene.emulation_sections import FaultKind, MuxFault, TileFault
from devices.scene.hardware_sections import ScheduleName
from devices.scene.scene_file import validate_scene
from tests.builders.witness import Verdict, Witness
from tests.devices.rigs import FOUR, SCHEDULES, TWO_MUXES, Plugs

BEGIN_S, LENGTH_S, RECOVERED_S, RUN_S = 0.7, 0.4, 1.2, 2.6
END_S = BEGIN_S + LENGTH_S
BAD = 1
OTHERS = [0, 2, 3]
EDGE_S = 0.016
"""Two frames of the slowest schedule: a tile is read up to a frame after the frame's instant."""

Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Run:
    """A stream that a fault befell."""

    frames: FrameBatch
    verdict: Verdict
    t_s: npt.NDArray[np.float64]
    array: TileArray

    def within(self, begin_s: float, end_s: float) -> Bools:
        return np.asarray((self.t_s >= begin_s) & (self.t_s < end_s))

    @property
    def during(self) -> Bools:
        return self.within(BEGIN_S + EDGE_S, END_S - EDGE_S)

    @property
    def before(self) -> Bools:
        return self.within(0.0, BEGIN_S - EDGE_S)

    @property
    def recovered(self) -> Bools:
        return self.within(END_S + RECOVERED_S, RUN_S)

    def rate_hz(self, rows: Bools) -> float:
        """Frames a second, of the median frame: a burst of audits is not a rate."""
        return float(1e9 / np.median(np.diff(self.frames.t_mono_ns)[rows[1:]]))

    def frames_a_second(self, begin_s: float, end_s: float) -> float:
        return float(self.within(begin_s, end_s).sum() / (end_s - begin_s))

    def flagged(self, tile: int, rows: Bools, bits: int) -> Bools:
        return np.asarray((self.frames.tile_flags[rows, tile] & bits) != 0)


@cache
def run(
    schedule: ScheduleName,
    kind: FaultKind | None,
    *,
    plugs: Plugs | None = None,
    mux: int = 0x70,
    rate: float = 0.02,
    length_s: float = LENGTH_S,
    seconds: float = RUN_S,
    recovery: bool = False,
    temperature_every: int = 1,
) -> Run:
    if plugs is None:
        # Mux by mux needs two of them; but then one without supply is no fault of the bus.
        plugs = TWO_MUXES if schedule == "per_mux" and kind != "brown_out" else FOUR
    fault: dict[str, Any] = {"kind": kind, "t_s": BEGIN_S, "duration_s": length_s}
    if kind in get_args(TileFault):
        fault["tile"] = f"T{BAD + 1:02d}"
    elif kind in get_args(MuxFault):
        fault["mux"] = mux
    elif kind in ("nack_storm", "bit_errors"):
        fault["rate"] = rate
    tiles = [
        {
            "serial": f"T{i + 1:02d}",
            "mux": plug[0],
            "channel": plug[1],
            "x_m": 0.014 * i,
            "y_m": 0.0,
            "z_m": -0.15,
        }
        for i, plug in enumerate(plugs)
    ]
    content = {
        "name": "faults",
        "tile": tiles,
        "array": {"schedule": schedule, "temperature_every": temperature_every},
        "ground": {"kind": "plate"},
        "fault": [fault] if kind else [],
    }
    scene = validate_scene(content, where="test")
    clock = VirtualClock(5_000_000_000)
    world = World(scene, clock, begins_now=False, lead_s=0.2)
    helper = GpioRecovery(EmulatedGpioLines(world.i2c_adapter, clock), clock) if recovery else None
    bus = open_bus("emulated", world.i2c_adapter)
    ready = prepare_array(bus, scene, clock, recovery=helper)
    witness = Witness(world)
    for _ in range(5):
        ready.array.scan_frame()
    world.begin_scene_time()
    begin_ns = clock.now_ns()
    stream = Acquisition(
        ready.array, ready.tiles, clock, UtcAnchor.from_readings(begin_ns, 0, clock_set=True)
    )
    end_ns = begin_ns + round(seconds * 1e9)
    frames = FrameBatch.concatenate(list(stream.acquire_batches(lambda: clock.now_ns() >= end_ns)))
    # What the very first frame holds was converted before the witness came.
    whole = witness.judge(frames, ready.tiles)
    verdict = Verdict(whole.given[1:], whole.same[1:], whole.right[1:], whole.error_kpa[1:])
    frames = frames.slice_rows(1, len(frames))
    t_s = np.asarray((frames.t_mono_ns - begin_ns) * 1e-9, dtype=np.float64)
    return Run(frames, verdict, t_s, ready.array)


every_schedule = pytest.mark.parametrize("schedule", SCHEDULES)


def cases(kinds: list[FaultKind]) -> pytest.MarkDecorator:
    """All schedules and kinds."""
    return pytest.mark.parametrize(
        ("schedule", "kind"), [(schedule, kind) for schedule in SCHEDULES for kind in kinds]
    )

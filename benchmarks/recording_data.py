"""What `recording.py` records, and how much: emulated arrays, and a walk measured on a person."""

from __future__ import annotations

import math
import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from devices.acquisition import BATCH_NS
from devices.emulation.ground.load_trace import LoadTrace
from devices.frames import FRAME_COLUMNS, ArrayInfo, FrameBatch
from devices.scene.scene_file import Scene, load_scene, validate_scene
from storage.formats.load_trace import read_load_to_emulate

FULL_RATE_HZ = 544.0
"""What four tiles at 1.6 ms give on a bus of 400 kHz, pipelined."""
WALK = "insole_walk_left.csv"
_ARC_M, _APART_RAD = 0.150, 0.0931
_BATCH_FRAMES_MAX = 64


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    Attributes:
        seconds: length of each recording.
        real_s: of the one on a real clock; 0: none.
        cost_s: recorded seconds over which appending is measured, twice.
        sealed_s: length of the journal that is sealed.
        sliced_s: length of the session from which a slice is read.
        turns: how often each job is timed.
        hours: length of the long journal.
        with_ladder: with all models, which need a calibration from the bench.
        walk: folder of the measured walk.
    """

    seconds: float = 120.0
    real_s: float = 60.0
    cost_s: float = 60.0
    sealed_s: float = 120.0
    sliced_s: float = 3600.0
    turns: int = 5
    hours: float = 0.2
    with_ladder: bool = True
    walk: Path = Path("../shared/data")


QUICK = Extent(
    seconds=3.0, real_s=2.0, cost_s=3.0, sealed_s=3.0, sliced_s=60.0, turns=2, hours=0.01,
    with_ladder=False,
)  # fmt: skip


@dataclass(frozen=True)
class Recording:
    """Frames of one stream, and what they are."""

    title: str
    info: ArrayInfo
    frames: FrameBatch

    @property
    def rate_hz(self) -> float:
        """Frames a second, all in all."""
        return (len(self.frames) - 1) / self.seconds

    @property
    def seconds(self) -> float:
        """From the first frame to the last."""
        return float(self.frames.t_mono_ns[-1] - self.frames.t_mono_ns[0]) * 1e-9


@cache
def emulated(tiles: int, seconds: float) -> Recording:
    """A foot arc with so many tiles that rolls over a plate, with a servo, in virtual time."""
    return _simulated(f"{tiles} tiles, virtual time", _arc(tiles), seconds, None)


def of_scene(name: str, seconds: float) -> Recording:
    """A built-in scene, in virtual time."""
    return _simulated(f"scene {name}", load_scene(name), seconds, None)


def walked(folder: Path, seconds: float) -> Recording | None:
    """A person's walk, pressed on eight emulated tiles; None if the recording is not there."""
    if not (folder / WALK).is_file():
        return None
    load = read_load_to_emulate(folder / WALK)
    there_s = float(load.time_s[-1] - load.time_s[0])  # after it the foot would hang in the air
    return _simulated("8 tiles, a person's walk", load_scene("insole"), min(seconds, there_s), load)


def on_real_clock(tiles: int, seconds: float) -> Recording:
    """The same arc with the clock and the sleeps of a real node, in a process as there."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(_on_real_clock, tiles, seconds).result()


def lengthened(recording: Recording, seconds: float, rate_hz: float = 0.0) -> Recording:
    """The recording over and over again, as one stream; with a rate, its times are drawn to it."""
    recording = at_rate(recording, rate_hz or recording.rate_hz)
    frames = repeated(recording.frames, 0, round(seconds * recording.rate_hz))
    return replace(recording, frames=frames)


def at_rate(recording: Recording, rate_hz: float) -> Recording:
    """The same frames, their times drawn to so many a second."""
    once = recording.frames
    factor = recording.rate_hz / rate_hz
    since_ns = np.rint((once.t_mono_ns - once.t_mono_ns[0]) * factor).astype(np.int64)
    frames = replace(once, t_mono_ns=once.t_mono_ns[0] + since_ns, t_ns=once.t_ns[0] + since_ns)
    info = recording.info.model_copy(update={"nominal_rate_hz": rate_hz})
    return Recording(recording.title, info, frames)


def repeated(once: FrameBatch, begin: int, end: int) -> FrameBatch:
    """Frames `begin` to `end` of a stream that is `once` over and over again, without a gap."""
    n = len(once)
    lap, at = np.divmod(np.arange(begin, end), n)
    step_ns = round(float(np.median(np.diff(once.t_mono_ns))))
    later_ns = lap * (int(once.t_mono_ns[-1] - once.t_mono_ns[0]) + step_ns)
    columns = {name: getattr(once, name)[at] for name in FRAME_COLUMNS}
    columns["seq"] = np.arange(begin, end, dtype=np.uint64)
    columns["t_mono_ns"] += later_ns
    columns["t_ns"] += later_ns
    return FrameBatch(**columns)


def batches(frames: FrameBatch) -> Iterator[FrameBatch]:
    """The frames as a node hands them over: some 25 ms at a time."""
    begin = 0
    while begin < len(frames):
        end_ns = frames.t_mono_ns[begin] + BATCH_NS
        window = frames.t_mono_ns[begin : begin + _BATCH_FRAMES_MAX]
        end = begin + max(1, int(np.searchsorted(window, end_ns)))
        yield frames.slice_rows(begin, end)
        begin = end


def _simulated(title: str, scene: Scene, seconds: float, load: LoadTrace | None) -> Recording:
    from service.offline.simulation import EmulatedRun, SimulationOptions
    from service.rig.emulated_foot import EmulatedFoot

    with ExitStack() as stack:
        simulation = EmulatedRun(SimulationOptions(scene, seconds, foot=EmulatedFoot(load)), stack)
        frames = FrameBatch.concatenate([frames for frames, _ in simulation.run_frames()])
    return Recording(title, simulation.info, frames)


def _on_real_clock(tiles: int, seconds: float) -> Recording:
    from service.rig.emulated_foot import RigOptions
    from service.rig.rig import Rig

    with ExitStack() as stack:
        rig = Rig(RigOptions(_arc(tiles), "bench"), stack)
        end_s = time.monotonic() + seconds
        frames = FrameBatch.concatenate(list(rig.acquire_batches(lambda: time.monotonic() > end_s)))
    return Recording(f"{tiles} tiles, real clock", rig.info, frames)


def _arc(tiles: int) -> Scene:
    content = load_scene("rolling").model_dump()
    angles_rad = [(i - (tiles - 1) / 2) * _APART_RAD for i in range(tiles)]
    content["tile"] = [
        {
            **content["tile"][0],
            "serial": f"T{i + 1:02d}",
            "channel": i,
            "x_m": _ARC_M * math.sin(angle_rad),
            "z_m": -_ARC_M * math.cos(angle_rad),
        }
        for i, angle_rad in enumerate(angles_rad)
    ]
    return validate_scene(content, where="benchmark")

"""Frames in, estimates out: one code path for ten rows live and ten million offline.

`step` takes the next frames and gives the estimates that are now due, `finish` those that are left.
Estimates come `lag` later than their frames, in order, exactly one per frame. Any way of cutting a
recording into batches gives the same bits: everything is done frame by frame, tile by tile, in one
compiled function, and what is remembered stays in records that it writes to.
"""

from __future__ import annotations

import math
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Times
from devices.compiled import compiled, inlined
from devices.frames import FrameBatch
from service.estimation.estimates import Estimates, EstimateStatus
from service.estimation.foot import UNKNOWN
from service.estimation.foot.contact import has_lasted
from service.estimation.foot.geometry import to_ground_x_m
from service.estimation.foot.kinematics import counts_at
from service.estimation.ladder import whole
from service.estimation.ladder.laws import Laws, make_laws
from service.estimation.ladder.lower import feel
from service.estimation.ladder.plan import EstimationPlan
from service.estimation.ladder.room import ROWS_LEAST, Room, make_room, moved
from service.estimation.ladder.state import at_rest
from service.estimation.ladder.taken import take
from service.estimation.ladder.upper import BORNE, BOUND_SIGMAS, bear
from service.estimation.models import denoise
from service.estimation.records import Columns, Record, Records, as_bytes

_COP_MASKED = int(EstimateStatus.COP_MASKED)
_AFTER_SATURATION = int(EstimateStatus.AFTER_SATURATION)
_GAUGE, _FORCE, _SIGMA = range(3)

_C_CONTIGUOUS, _ALIGNED, _WRITEABLE = 0x1, 0x100, 0x400  # numpy's own, of `flags.num`
_LAYOUT = _C_CONTIGUOUS | _ALIGNED | _WRITEABLE
_COMPILED_LAYOUT = _C_CONTIGUOUS | _ALIGNED
_COLUMNS = (
    "seq",
    "t_mono_ns",
    "t_ns",
    "padc",
    "tadc",
    "sample_offset_us",
    "servo_counts",
    "servo_age_us",
    "status",
    "frame_status",
)
"""Of frames, in the order in which `_step` takes them."""
Answers = tuple[
    npt.NDArray[np.uint64],
    Times,
    Floats,
    Floats,
    npt.NDArray[np.uint8],
    npt.NDArray[np.uint16],
]


class Estimator:
    """Estimates of consecutive frames of one stream, with one tare.

    Args:
        plan: constants of the estimate.
    """

    def __init__(self, plan: EstimationPlan) -> None:
        self.plan = plan
        self._laws = make_laws(plan)
        tiles = len(plan.info.tiles)
        self._scene, self._tiles = at_rest(tiles)
        self._room = make_room(ROWS_LEAST, tiles)
        axes = zip(whole.ALONG, plan.cop_measured, strict=True)
        self._unmeasured = [row for rows, is_measured in axes if not is_measured for row in rows]

    def step(self, frames: FrameBatch) -> Estimates:
        """Take the next frames, in order; return the estimates that are due.

        Args:
            frames: n frames with rising `seq` and `t_mono_ns`.

        Returns:
            The estimates due; any number, possibly none.

        Raises:
            ValueError: the frames are not of as many tiles as the plan; compiled code would read
                beside them.
        """
        n = len(frames)
        if frames.tile_count != len(self._tiles):
            raise ValueError(f"frames of {frames.tile_count} tiles, a plan of {len(self._tiles)}")
        if self._scene["end"][0] + n > len(self._room.rows):
            self._make_room(n)
        columns = [_as_compiled(getattr(frames, name)) for name in _COLUMNS]
        answers = _step(self._laws, self._scene, self._tiles, self._room, *columns)
        return _estimates(answers, self._unmeasured)

    def finish(self) -> Estimates | None:
        """The estimates that still wait for their look-ahead, at the end; None if none wait."""
        if self._scene["due"][0] == self._scene["end"][0]:
            return None
        answers = _finish(self._laws, self._scene, self._tiles, self._room)
        return _estimates(answers, self._unmeasured)

    def kept(self) -> Columns:
        """All that it remembers, for another one to go on with; records as their bytes."""
        self._make_room(0)  # rows that nothing reaches back to any more are not worth keeping
        return {name: as_bytes(column).copy() for name, column in self._memory().items()}

    @classmethod
    def going_on(cls, plan: EstimationPlan, kept: Columns) -> Self:
        """One that goes on with what another has kept: both together give the bits of one.

        Args:
            plan: the other's.
            kept: by it, in this very version.

        Raises:
            ValueError: it is of another plan; compiled code would read beside it.
        """
        new = cls(plan)
        rows = len(kept["t_mono_ns"])
        new._room = make_room(max(ROWS_LEAST, rows), len(new._tiles))
        new._scene["end"] = rows
        for name, column in new._memory().items():
            memory, given = as_bytes(column), kept[name]
            if (given.dtype, given.shape) != (memory.dtype, memory.shape):
                raise ValueError(f"{name} is {given.dtype}{given.shape}, not {memory.shape}")
            memory[...] = given
        due, read, end = (int(new._scene[mark][0]) for mark in ("due", "read", "end"))
        if not 0 <= due <= read <= end == rows:
            raise ValueError(f"its rows are {due}, {read}, {end} of {rows}")
        return new

    def _memory(self) -> Columns:
        end = int(self._scene["end"][0])
        room = {name: column[:end] for name, column in self._room._asdict().items()}
        return {"scene": self._scene, "tiles": self._tiles, **room}

    def _make_room(self, more: int) -> None:
        scene = self._scene[0]
        keep = min(scene["due"], max(scene["read"] - 1, 0))
        if self.plan.ladder.denoise and scene["end"]:
            t_mono_ns = self._room.t_mono_ns[: scene["end"]]
            # The next one may not be here yet; it will be no earlier than the last that is.
            oldest_ns = t_mono_ns[min(scene["due"], scene["end"] - 1)] - denoise.PAST_NS
            within = int(np.searchsorted(t_mono_ns, oldest_ns))
            keep = min(keep, max(within, scene["due"] - int(denoise.REACHES[-1])))
        self._room = moved(self._room, keep, scene["end"], more)
        for mark in ("due", "read", "end"):
            scene[mark] -= keep


def _as_compiled(column: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """In row order, aligned and read-only, as frames of a message are: compiled once, for that."""
    if column.flags.num & _LAYOUT == _COMPILED_LAYOUT:
        return column
    column = np.array(column, order="C")
    column.setflags(write=False)
    return column


def _estimates(answers: Answers, unmeasured: list[int]) -> Estimates:
    seq, t_ns, by_tile, by_frame, contact, status = answers
    # Not before: whether a centre of pressure is masked is decided with the row's place.
    by_frame[unmeasured] = math.nan
    return Estimates(
        seq=seq,
        t_ns=t_ns,
        gauge_kpa=by_tile[_GAUGE],
        force_n=by_tile[_FORCE],
        force_sigma_n=by_tile[_SIGMA],
        grf_n=by_frame[whole.GRF],
        grf_sigma_n=by_frame[whole.GRF_SIGMA],
        grf_at_least_n=by_frame[whole.AT_LEAST],
        cop_x_m=by_frame[whole.X],
        cop_y_m=by_frame[whole.Y],
        cop_sigma_x_m=by_frame[whole.SIGMA_X],
        cop_sigma_y_m=by_frame[whole.SIGMA_Y],
        cop_index_x=by_frame[whole.INDEX_X],
        cop_index_y=by_frame[whole.INDEX_Y],
        cop_ground_x_m=by_frame[whole.GROUND_X],
        cop_ground_y_m=by_frame[whole.GROUND_Y],
        angle_rad=by_frame[whole.ANGLE],
        contact=contact,
        estimate_status=status,
    )


@compiled
def _step(
    laws: Laws,
    scenes: Records,
    tiles: Records,
    room: Room,
    seq: npt.NDArray[np.uint64],
    t_mono_ns: Times,
    t_ns: Times,
    padc: npt.NDArray[np.uint16],
    tadc: npt.NDArray[np.uint16],
    sample_offset_us: npt.NDArray[np.int32],
    servo_counts: npt.NDArray[np.int32],
    servo_age_us: npt.NDArray[np.int32],
    status: npt.NDArray[np.uint8],
    frame_status: npt.NDArray[np.uint8],
) -> Answers:
    scene = scenes[0]
    take(
        laws, scene, tiles, room, seq, t_mono_ns, t_ns, padc, tadc, sample_offset_us, servo_counts,
        servo_age_us, status, frame_status,
    )  # fmt: skip
    # With look-ahead and averages, a frame waits for the next to show whether it is an outlier.
    while scene.read < scene.end - laws.scene[0].waits:
        feel(laws, scene, tiles, room, scene.read)
        scene.read += 1
    until = scene.due
    while until < scene.read and room.t_mono_ns[until] <= scene.newest_ns - laws.scene[0].lag_ns:
        until += 1
    return _released(laws, scene, tiles, room, until)


@compiled
def _finish(laws: Laws, scenes: Records, tiles: Records, room: Room) -> Answers:
    scene = scenes[0]
    while scene.read < scene.end:
        feel(laws, scene, tiles, room, scene.read)
        scene.read += 1
    return _released(laws, scene, tiles, room, scene.end)


@inlined
def _released(laws: Laws, scene: Record, tiles: Records, room: Room, until: int) -> Answers:
    """Estimate the rows up to `until`, now that their look-ahead is there."""
    n, count, law = until - scene.due, len(tiles), laws.scene[0]
    seq, t_ns = np.empty(n, np.uint64), np.empty(n, np.int64)
    by_tile = np.full((3, n, count), math.nan)
    by_frame = np.full((whole.COLUMNS, n), math.nan)
    contact, status = np.empty(n, np.uint8), np.empty(n, np.uint16)
    out, windows = np.empty(whole.COLUMNS), denoise.scratch_of_windows()
    borne = np.zeros(count, BORNE)
    # Without look-ahead the next frame is not there, and may be of the same instant.
    look_ns = law.look_ns if law.waits == 1 else -1
    rows = (scene.due, scene.due)
    for k in range(n):
        i = scene.due
        row = room.rows[i]
        out[:] = math.nan
        if law.denoise == 1:
            rows = denoise.in_sight(room.t_mono_ns, i, 0, scene.read, rows, look_ns)
        unsettled = bear(laws, tiles, room, i, rows, windows, borne)
        if law.servo == 1:
            counts = counts_at(room.readings, i, scene.read, law.look_ns)
            out[whole.ANGLE] = (counts - law.zero_counts) * law.rad_per_count
        whole.push(laws, borne, out[whole.ANGLE])
        whole.stand(laws, borne, out)
        if has_lasted(room.since_ns, room.t_mono_ns, i, scene.read, law.min_ns, law.look_ns):
            scene.is_contact = row.loaded
        masked = whole.is_masked(laws, out) or scene.is_contact == 0
        # A bound tells that there is contact, and never that there is none.
        known = not math.isnan(out[whole.GRF])
        decided = known or (scene.is_contact == 1 and out[whole.AT_LEAST] >= law.bound_on_n)
        if masked:
            out[whole.X : whole.ANGLE] = math.nan
        else:
            _place(laws, room.cells[i], out)
        for j in range(count):
            by_tile[_GAUGE, k, j] = room.cells[i, j].gauge_kpa
            if laws.tiles[j].bears == 1:
                by_tile[_FORCE, k, j], by_tile[_SIGMA, k, j] = _stated(borne[j])
        by_frame[:, k] = out
        seq[k], t_ns[k] = row.seq, row.t_ns
        contact[k] = scene.is_contact if decided else UNKNOWN
        status[k] = (
            row.status | (_COP_MASKED if masked else 0) | (_AFTER_SATURATION if unsettled else 0)
        )
        scene.due += 1
    return seq, t_ns, by_tile, by_frame, contact, status


@inlined
def _place(laws: Laws, cells: Records, out: Floats) -> None:
    """Indices of the centre of pressure, and where it is on the ground."""
    scene = laws.scene[0]
    if scene.grid == 1:
        whole.note_index(laws, cells, out)
    if scene.servo == 1 and not math.isnan(scene.travel_m_per_rad):
        out[whole.GROUND_X] = to_ground_x_m(
            out[whole.X], out[whole.Z], out[whole.ANGLE], scene.travel_m_per_rad
        )
        out[whole.GROUND_Y] = out[whole.Y]


@compiled
def _stated(borne: Record) -> tuple[float, float]:
    """A tile's force and its uncertainty, or a bound that the truth exceeds in 99 of 100 frames."""
    if borne.beyond == 1:
        return borne.force_n - BOUND_SIGMAS * borne.sigma_n, math.nan
    return borne.force_n, borne.sigma_n

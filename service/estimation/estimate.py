"""Estimator: frames to estimates, with one code path for ten rows live and ten million offline.

`process_frames` returns the estimates that are due, `finish` the remaining ones. Estimates come a
look-ahead later than their frames, in order, exactly one per frame. Any batches of a recording give
the same bits: one compiled function works frame by frame and tile by tile, and its state is in
records.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, Protocol, Self, cast

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Times
from devices.flags import CONTACT_UNKNOWN, EstimateFlag
from devices.frames import FrameBatch, allocate_columns
from devices.jit import jit_cached, jit_inlined
from service.estimation.foot import interpolate_servo_counts, transform_to_ground_x_m
from service.estimation.models import denoise
from service.estimation.pipeline import grf_cop
from service.estimation.pipeline.contact import update_contact
from service.estimation.pipeline.params import KernelParams
from service.estimation.pipeline.plan import EstimationPlan
from service.estimation.pipeline.sample_stage import (
    append_frames_to_buffer,
    compute_apparent_forces,
)
from service.estimation.pipeline.smoothing_stage import (
    BOUND_SIGMAS,
    TILE_FORCE,
    TileForce,
    compute_forces_and_flags,
)
from service.estimation.pipeline.state import (
    ROWS_MIN,
    FootState,
    FrameBuffer,
    TileSample,
    TileState,
    compact_or_grow_buffer,
    make_frame_buffer,
)
from service.estimation.records import ColumnDict, Estimates, RecordArray, view_records_as_bytes

_COP_MASKED = int(EstimateFlag.COP_MASKED)
_GAUGE, _FORCE, _SIGMA = range(3)

_C_CONTIGUOUS, _ALIGNED, _WRITEABLE = 0x1, 0x100, 0x400  # numpy's own, of `flags.num`
_LAYOUT = _C_CONTIGUOUS | _ALIGNED | _WRITEABLE
_COMPILED_LAYOUT = _C_CONTIGUOUS | _ALIGNED
_COLUMNS = (
    "seq",
    "t_mono_ns",
    "t_ns",
    "pressure_raw",
    "temperature_raw",
    "sample_offset_us",
    "servo_counts",
    "servo_age_us",
    "tile_flags",
    "frame_flags",
)
"""Columns of frames, in the order of the parameters of `_step`."""
_COUNTS = slice(_COLUMNS.index("pressure_raw"), _COLUMNS.index("temperature_raw") + 1)
_WORD_BYTES = 2  # of the words in which compiled code takes counts
_ROW_FIELDS = ("release_row", "sample_row", "end_row")
"""Rows of the buffer in `FootState`."""
KernelOutput = tuple[
    npt.NDArray[np.uint64],
    Times,
    Floats,
    Floats,
    npt.NDArray[np.uint8],
    npt.NDArray[np.uint16],
]


class Estimator(Protocol):
    """Estimator of consecutive frames of one stream, with one tare.

    Every frame has exactly one estimate, in order. Any batches give the same bits, also if a state
    is taken between them. A frame without a reading of a tile has NaN and a flag, never a number.
    """

    name: ClassVar[str]
    """Name in options and in the notes of a file."""

    def __init__(self, plan: EstimationPlan) -> None: ...

    def process_frames(self, frames: FrameBatch) -> Estimates:
        """Add the next frames, with rising `seq` and `t_mono_ns`; return the estimates now due."""
        ...

    def finish(self) -> Estimates | None:
        """Return the estimates that still wait for their look-ahead; None if there are none."""

    def state_dict(self) -> ColumnDict:
        """Return a copy of the state for `from_state`."""
        ...

    @classmethod
    def from_state(cls, plan: EstimationPlan, state: ColumnDict) -> Self:
        """Make an estimator that continues from a state, with the bits of an uninterrupted one.

        Raises:
            ValueError: the state is of another plan.
        """
        ...


class ModelEstimator:
    """Estimator by the models of a plan, with their look-ahead.

    Args:
        plan: parameters of the estimate.
    """

    name: ClassVar = "models"

    def __init__(self, plan: EstimationPlan) -> None:
        self.plan = plan
        tiles = len(plan.info.tiles)
        self._foot_state, self._tile_states = FootState.array(1), TileState.array(tiles)
        self._buffer = make_frame_buffer(ROWS_MIN, tiles)
        axes = zip(grf_cop.COLUMNS_BY_AXIS, plan.cop_measured, strict=True)
        self._unmeasured = [row for rows, is_measured in axes if not is_measured for row in rows]

    def process_frames(self, frames: FrameBatch) -> Estimates:
        """Add the next frames; return the estimates now due, a look-ahead later than their frames.

        Args:
            frames: n frames with rising `seq` and `t_mono_ns`.

        Returns:
            The estimates due; any number, possibly none.

        Raises:
            ValueError: frames and plan differ in the number of tiles; compiled code would read
                beyond their memory.
        """
        n = len(frames)
        tiles = len(self._tile_states)
        if frames.tile_count != tiles:
            raise ValueError(f"frames of {frames.tile_count} tiles, a plan of {tiles}")
        if self._foot_state["end_row"][0] + n > len(self._buffer.rows):
            self._compact_buffer(n)
        return self._step(frames, is_final=False)

    def finish(self) -> Estimates | None:
        """Return the estimates that still wait for their look-ahead; None if there are none."""
        if self._foot_state["release_row"][0] == self._foot_state["end_row"][0]:
            return None
        nothing = FrameBatch(**allocate_columns(0, len(self._tile_states), np.dtype(np.uint16)))
        return self._step(nothing, is_final=True)

    def state_dict(self) -> ColumnDict:
        """Return a copy of the state for `from_state`, records as bytes; compacts the buffer."""
        self._compact_buffer(0)  # drops rows that nothing reaches back to
        return {
            name: view_records_as_bytes(column).copy()
            for name, column in self._state_columns().items()
        }

    @classmethod
    def from_state(cls, plan: EstimationPlan, state: ColumnDict) -> Self:
        """Make an estimator that continues from a state, with the bits of an uninterrupted one.

        Args:
            plan: plan of the estimator that the state comes from.
            state: result of `state_dict`, of the same version.

        Raises:
            ValueError: the state is of another plan; compiled code would read beyond its memory.
        """
        new = cls(plan)
        rows = len(state["t_mono_ns"])
        new._buffer = make_frame_buffer(max(ROWS_MIN, rows), len(new._tile_states))
        new._foot_state["end_row"] = rows
        for name, column in new._state_columns().items():
            memory, given = view_records_as_bytes(column), state[name]
            if (given.dtype, given.shape) != (memory.dtype, memory.shape):
                raise ValueError(f"{name} is {given.dtype}{given.shape}, not {memory.shape}")
            memory[...] = given
        due, sample, end = (int(new._foot_state[name][0]) for name in _ROW_FIELDS)
        if not 0 <= due <= sample <= end == rows:
            raise ValueError(f"its rows are {due}, {sample}, {end} of {rows}")
        return new

    def _step(self, frames: FrameBatch, *, is_final: bool) -> Estimates:
        columns = [_to_compiled_layout(getattr(frames, name)) for name in _COLUMNS]
        if frames.pressure_raw.itemsize > _WORD_BYTES:
            columns[_COUNTS] = [counts.view(np.uint16) for counts in columns[_COUNTS]]
        states = self._foot_state, self._tile_states
        output = _step(self.plan.params, *states, self._buffer, is_final, *columns)
        return _make_estimates(output, self._unmeasured)

    def _state_columns(self) -> ColumnDict:
        end = int(self._foot_state["end_row"][0])
        rows = {name: column[:end] for name, column in self._buffer._asdict().items()}
        states = {"foot_state": self._foot_state, "tile_states": self._tile_states}
        return cast("ColumnDict", {**states, **rows})

    def _compact_buffer(self, new_rows: int) -> None:
        due, sample, end = (int(self._foot_state[name][0]) for name in _ROW_FIELDS)
        first = min(due, max(sample - 1, 0))
        if "denoise" in self.plan.models and end:
            t_mono_ns = self._buffer.t_mono_ns[:end]
            # The next frame may not be here yet; it will be no earlier than the last that is.
            oldest_ns = t_mono_ns[min(due, end - 1)] - denoise.PAST_NS
            within = int(np.searchsorted(t_mono_ns, oldest_ns))
            first = min(first, max(within, due - int(denoise.WINDOW_REACHES[-1])))
        self._buffer = compact_or_grow_buffer(self._buffer, first, end, new_rows)
        for name in _ROW_FIELDS:
            self._foot_state[name] -= first


def _to_compiled_layout(column: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a column in row order, aligned and read-only: compiled for that only."""
    if column.flags.num & _LAYOUT == _COMPILED_LAYOUT:
        return column
    column = np.array(column, order="C")
    column.setflags(write=False)
    return column


def _make_estimates(output: KernelOutput, unmeasured: list[int]) -> Estimates:
    seq, t_ns, by_tile, by_frame, contact, status = output
    # Afterwards: masking of the centre of pressure needs the row's position.
    for row in unmeasured:  # mostly none; an index of an empty list takes 5 us
        by_frame[row] = math.nan
    # In the order of the fields; the last row of a frame, `COP_Z`, is none of them.
    columns: list[Any] = [seq, t_ns, *by_tile, *by_frame[: grf_cop.COP_Z], contact, status]
    return Estimates(*columns)


@jit_cached
def _step(
    params: KernelParams,
    foot_states: RecordArray[FootState],
    tile_states: RecordArray[TileState],
    buffer: FrameBuffer,
    is_final: bool,
    seq: npt.NDArray[np.uint64],
    t_mono_ns: Times,
    t_ns: Times,
    pressure_raw: npt.NDArray[np.uint16],
    temperature_raw: npt.NDArray[np.uint16],
    sample_offset_us: npt.NDArray[np.int32],
    servo_counts: npt.NDArray[np.int32],
    servo_age_us: npt.NDArray[np.int32],
    tile_flags: npt.NDArray[np.uint8],
    frame_flags: npt.NDArray[np.uint8],
) -> KernelOutput:
    foot_params, foot_state = params.foot[0], foot_states[0]
    append_frames_to_buffer(
        params, foot_state, tile_states, buffer, seq, t_mono_ns, t_ns, pressure_raw,
        temperature_raw, sample_offset_us, servo_counts, servo_age_us, tile_flags, frame_flags,
    )  # fmt: skip
    # With look-ahead and averages, a frame waits for the next one, for outlier replacement.
    end = foot_state.end_row if is_final else foot_state.end_row - foot_params.waits_for_next
    while foot_state.sample_row < end:
        compute_apparent_forces(params, foot_state, tile_states, buffer, foot_state.sample_row)
        foot_state.sample_row += 1
    until, due_ns = foot_state.release_row, foot_state.newest_ns - foot_params.lag_ns
    while until < foot_state.sample_row and (is_final or buffer.t_mono_ns[until] <= due_ns):
        until += 1
    # Only here: callees have no reference counts, and so do not allocate.
    n, tiles = until - foot_state.release_row, len(tile_states)
    output = (
        np.empty(n, np.uint64),
        np.empty(n, np.int64),
        np.empty((3, n, tiles)),
        np.empty((grf_cop.N_COLUMNS, n)),
        np.empty(n, np.uint8),
        np.empty(n, np.uint16),
    )
    windows, forces = np.empty(denoise.SCRATCH_SHAPE), np.zeros(tiles, TILE_FORCE)
    _estimate_due_rows(params, foot_state, tile_states, buffer, windows, forces, output)
    return output


@jit_inlined
def _estimate_due_rows(
    params: KernelParams,
    foot_state: FootState,
    tile_states: RecordArray[TileState],
    buffer: FrameBuffer,
    windows: Floats,
    forces: RecordArray[TileForce],
    output: KernelOutput,
) -> None:
    """Estimate the next rows, as many as `output` has; their look-ahead is complete."""
    foot_params, count = params.foot[0], len(tile_states)
    seq, t_ns, by_tile, by_frame, contact, flags = output
    # Without look-ahead the next frame is not there, and may be of the same instant.
    look_ns = foot_params.lookahead_ns if foot_params.waits_for_next == 1 else -1
    rows = (foot_state.release_row, foot_state.release_row)
    end, lookahead_ns = foot_state.sample_row, foot_params.lookahead_ns
    for k in range(len(seq)):
        i = foot_state.release_row
        row, out = buffer.rows[i], by_frame[:, k]
        out[:] = math.nan
        if foot_params.has_denoise == 1:
            rows = denoise.find_oldest_and_newest_window_rows(
                buffer.t_mono_ns, i, end, rows, look_ns
            )
        unseen = compute_forces_and_flags(params, tile_states, buffer, i, rows, windows, forces)
        if foot_params.has_servo == 1:
            counts = interpolate_servo_counts(buffer.readings, i, end, lookahead_ns)
            out[grf_cop.FOOT_ANGLE] = (counts - foot_params.zero_counts) * foot_params.rad_per_count
        grf_cop.set_plate_shear_fractions_and_sigma(params, forces, out[grf_cop.FOOT_ANGLE])
        grf_cop.compute_grf_cop(params, forces, out)
        update_contact(foot_params, foot_state.contact, buffer, i, end, forces)
        in_contact = foot_state.contact.is_contact == 1
        masked = grf_cop.is_cop_unreliable(params, out) or not in_contact
        # A lower bound can prove contact, and never its absence.
        is_proven = in_contact and out[grf_cop.GRF_LOWER_BOUND] >= foot_params.contact_bound_n
        is_known = not math.isnan(out[grf_cop.GRF]) or is_proven
        if masked:
            out[grf_cop.COP_X : grf_cop.FOOT_ANGLE] = math.nan
        else:
            _compute_cop_positions(params, buffer.samples[i], out)
        for j in range(count):
            by_tile[_GAUGE, k, j] = buffer.samples[i, j].gauge_kpa
            by_tile[_FORCE, k, j] = by_tile[_SIGMA, k, j] = math.nan
            if params.tiles[j].is_load_bearing == 1:
                by_tile[_FORCE, k, j], by_tile[_SIGMA, k, j] = _force_or_bound(forces[j])
        seq[k], t_ns[k] = row.seq, row.t_ns
        contact[k] = foot_state.contact.is_contact if is_known else CONTACT_UNKNOWN
        flags[k] = row.flags | unseen | (_COP_MASKED if masked else 0)
        foot_state.release_row += 1


@jit_inlined
def _compute_cop_positions(
    params: KernelParams, samples: RecordArray[TileSample], out: Floats
) -> None:
    """Compute the grid indices of the COP, and its position on the ground."""
    foot_params = params.foot[0]
    if foot_params.has_grid == 1:
        grf_cop.compute_gauge_weighted_cop_index(params, samples, out)
    if foot_params.has_servo == 1 and not math.isnan(foot_params.travel_m_per_rad):
        out[grf_cop.COP_GROUND_X] = transform_to_ground_x_m(
            out[grf_cop.COP_X],
            out[grf_cop.COP_Z],
            out[grf_cop.FOOT_ANGLE],
            foot_params.travel_m_per_rad,
        )
        out[grf_cop.COP_GROUND_Y] = out[grf_cop.COP_Y]


@jit_cached
def _force_or_bound(force: TileForce) -> tuple[float, float]:
    """Return a tile's force and sigma, or a bound that the truth exceeds in 99 of 100 frames."""
    if force.is_saturated == 1:
        return force.force_n - BOUND_SIGMAS * force.sigma_n, math.nan
    return force.force_n, force.sigma_n

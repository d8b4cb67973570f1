"""Preparation of a session's re-estimation: options, time range, calibration, models, tares.

Models have state: rubber creep, gas temperature, temperature trend. They start before the part by
several times their longest time constant, so that the effect of earlier frames is small; before the
session's first frame with its warm-up frames. State without a time limit, such as open hysteresis
loops and past faults, starts empty.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, get_args

import numpy as np

from devices.arrays import Columns
from devices.errors import CalibrationError, FileFormatError, TareError, UsageError
from devices.frames import ArrayInfo, FrameBatch
from devices.scene.emulation_sections import PartFamily
from devices.scene.scene_file import Scene
from service.estimation.calibration import Calibration
from service.estimation.estimate import Estimator, ModelEstimator
from service.estimation.pipeline.plan import EstimationPlan, compute_settling_time_s
from service.estimation.tare.tare import Tare
from service.offline.calibration_lookup import (
    EMULATED_RIG,
    find_calibration,
    read_calibration_of_session,
)
from service.sessions.estimate_stream import EstimateOptions
from storage.formats.slice import Slice
from storage.schema import INDENTER_COLUMNS, PART_COLUMNS, TRUTH_COLUMNS
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import NODE_AXIS, TimeAxis
from storage.sessions.warm_up import read_warm_up, with_part_column

_ALL = Slice()
CHUNK_FRAMES = 1 << 20
"""Frames per chunk: half an hour at 544 Hz, some ten seconds of work, which a kill may cost."""


@dataclass(frozen=True)
class EstimateRequest:
    """Options of an estimate; see `foottile estimate --help` for their defaults.

    Attributes:
        calibration: a calibration, or its file, preset or id; None: the session's own.
        models: model names; None: the scene's.
        lag_ms: look-ahead.
        scene: source of models, calibration and tile positions; None: the session's.
        tare_s: unloaded interval, in seconds from the first frame of the session.
        part: time range to estimate; only the needed part of the file is read.
        unquantized: True to store unquantized values.
        estimator: of the frames.
    """

    calibration: str | Calibration | None
    models: tuple[str, ...] | None
    lag_ms: float
    scene: Scene | None
    tare_s: tuple[float, float] | None
    part: Slice = _ALL
    unquantized: bool = False
    estimator: type[Estimator] = ModelEstimator


BatchWithColumns = tuple[FrameBatch, Columns]
_READ_MARGIN_NS = 1_000_000_000
"""Time read behind the part beyond the look-ahead: a frame may need its successor."""


@dataclass(frozen=True)
class EstimationRange:
    """Range of frames to read and to output; by default all.

    Attributes:
        run_from_ns: time from which models run, on the time axis; None: from the first frame.
        output_begin_ns: begin of the output; None: the session's first frame.
        output_end_ns: end of the output, exclusive; None: to the end.
        read_until_ns: end of the frames needed for the look-ahead, exclusive.
        row_groups: row groups to read; None: all.
        axis: the session's time axis.
    """

    run_from_ns: int | None = None
    output_begin_ns: int | None = None
    output_end_ns: int | None = None
    read_until_ns: int | None = None
    row_groups: tuple[int, ...] | None = None
    axis: TimeAxis = NODE_AXIS

    @property
    def warm_up_s(self) -> float | None:
        """Warm-up time of the models before the part; None: from the session's begin."""
        if self.run_from_ns is None or self.output_begin_ns is None:
            return None
        return (self.output_begin_ns - self.run_from_ns) * 1e-9

    def select_needed(self, pieces: Iterable[BatchWithColumns]) -> Iterator[BatchWithColumns]:
        """Yield the frames that models run over."""
        return self._select_time_range(pieces, self.run_from_ns, self.read_until_ns)

    def select_output(self, pieces: Iterable[BatchWithColumns]) -> Iterator[BatchWithColumns]:
        """Yield the output frames."""
        return self._select_time_range(pieces, self.output_begin_ns, self.output_end_ns)

    def _select_time_range(
        self, pieces: Iterable[BatchWithColumns], begin_ns: int | None, end_ns: int | None
    ) -> Iterator[BatchWithColumns]:
        for frames, columns in pieces:
            at_ns = self.axis.shift_to_axis(frames.t_ns, columns.get("part"))
            inside = np.ones(len(frames), dtype=np.bool_)
            if begin_ns is not None:
                inside &= at_ns >= begin_ns
            if end_ns is not None:
                inside &= at_ns < end_ns
            if inside.all():
                yield frames, columns
            elif inside.any():
                yield frames.select_rows(inside), {name: v[inside] for name, v in columns.items()}


def compute_estimation_range(
    session: SealedFileReader, part: Slice, plan: EstimationPlan
) -> EstimationRange:
    """Compute the range to read for the estimate of a part of a session.

    Args:
        session: the session.
        part: time range; its columns are ignored.
        plan: constants of the estimate.

    Raises:
        UsageError: the part begins after the session's end.
        FileFormatError: the file is damaged.
    """
    first_ns, last_ns = session.read_span_on_axis_ns()
    begin_ns, end_ns = part.compute_bounds_ns(first_ns)
    if begin_ns is not None and begin_ns > last_ns:
        raise UsageError(
            f"--start-s {part.start_s:g}: the session ends at {(last_ns - first_ns) * 1e-9:.3f} s",
            expected="a start before the session's end",
        )
    from_ns = None if begin_ns is None else begin_ns - round(1e9 * compute_settling_time_s(plan))
    if from_ns is not None and from_ns <= first_ns:
        from_ns = None
    until_ns = None if end_ns is None else end_ns + plan.lag_ns + _READ_MARGIN_NS
    groups = tuple(session.find_overlapping_row_groups(from_ns, until_ns))
    return EstimationRange(from_ns, begin_ns, end_ns, until_ns, groups, session.time_axis)


def read_warm_up_or_remark(
    session: SealedFileReader, stretch: EstimationRange, on_remark: Callable[[str], None]
) -> Iterator[BatchWithColumns]:
    """Yield a session's warm-up frames, if models run from its begin; none if they are damaged.

    Args:
        session: the session.
        stretch: range of the estimate.
        on_remark: called if there should be some and there are none.
    """
    if stretch.run_from_ns is not None:
        return
    try:
        found = read_warm_up(session.path, session.notes)
    except FileFormatError as error:
        on_remark(f"models begin without history, as far as flags and sigma say: {error}")
        return
    yield from map(with_part_column, found)


def select_tares_in_force(tares: Sequence[Tare], from_ns: int | None) -> tuple[Tare, ...]:
    """Return the tares in force from a time on, oldest first; None: all tares."""
    if from_ns is None:
        return tuple(tares)
    over = sum(later.t_ns < from_ns for _, later in pairwise(tares))
    return tuple(tares[over:])


@dataclass(frozen=True)
class PreparedEstimate:
    """Resolved request for one session.

    Attributes:
        info: its array, with the requested tile positions.
        options: options of the estimate.
        kept_columns: columns of the session, beside the frames, that are copied unchanged.
    """

    info: ArrayInfo
    options: EstimateOptions
    kept_columns: tuple[str, ...]


def prepare_estimate(
    session: SealedFileReader, request: EstimateRequest, on_remark: Callable[[str], None]
) -> PreparedEstimate:
    """Resolve a request for a session.

    Raises:
        FootTileError: scene or calibration do not fit the session.
    """
    scene, info = request.scene, _place_tiles(session.info, request.scene)
    options = EstimateOptions(
        calibration=_find_calibration(session, scene, request.calibration, on_remark),
        models=request.models or (scene.models if scene else info.models),
        lag_ms=request.lag_ms,
        tare_s=request.tare_s,
        tares=_read_tares(session) if request.tare_s is None else (),
        unquantized=request.unquantized,
        estimator=request.estimator,
    )
    kept = tuple(
        c.name
        for c in (*PART_COLUMNS, *TRUTH_COLUMNS, *INDENTER_COLUMNS)
        if session.has_columns(c.name)
    )
    return PreparedEstimate(info, options, kept)


def _read_tares(session: SealedFileReader) -> tuple[Tare, ...]:
    """Read the tares recorded in the session, oldest first."""
    recorded = session.notes.get("tares", [])
    tiles = len(session.info.tiles)
    try:
        return tuple(Tare.from_dict(content, tiles=tiles) for content in recorded)
    except (TareError, TypeError) as error:
        raise FileFormatError(
            f"its tares are not readable: {error}",
            where=str(session.path),
            remedy="Name an unloaded interval with --tare-s BEGIN,END",
        ) from error


def _place_tiles(info: ArrayInfo, scene: Scene | None) -> ArrayInfo:
    """Return the array with the scene's tile positions."""
    if scene is None:
        return info
    places = {tile.serial: tile for tile in scene.tile}
    if set(places) != set(info.serials):
        raise UsageError(
            f"scene {scene.name!r} has the tiles {', '.join(sorted(places))}, "
            f"the session {', '.join(sorted(info.serials))}",
            remedy="Name the scene it was recorded with",
        )
    tiles = tuple(
        tile.model_copy(
            update={
                name: getattr(places[tile.serial], name)
                for name in ("x_m", "y_m", "z_m", "reference")
            }
        )
        for tile in info.tiles
    )
    return info.model_copy(update={"tiles": tiles})


def _find_calibration(
    session: SealedFileReader,
    scene: Scene | None,
    wanted: str | Calibration | None,
    remark: Callable[[str], None],
) -> Calibration:
    notes = session.notes
    where = str(session.path)
    serials = [tile.serial for tile in session.info.tiles if not tile.reference]
    if isinstance(wanted, Calibration):
        wanted.get_tiles_or_wildcard(serials)
        return wanted
    inside = None
    try:
        inside = read_calibration_of_session(session)
    except FileFormatError:
        if wanted is None:
            raise
    if inside is not None and wanted in (None, inside.id):
        return inside
    name = wanted or (scene.calibration if scene is not None else None)
    if name is None:
        raise CalibrationError(
            "no calibration: the session brings none and none was named",
            where=where,
            remedy="Add --calibration FILE, or --scene with a scene that names one",
        )
    if name == EMULATED_RIG and "parts_seed" not in notes:
        # The emulated rig would calibrate an emulated tile of the same serial: plausible and wrong.
        raise CalibrationError(
            "the emulated rig calibrates emulated tiles only, and this session has real ones",
            where=where,
            remedy="Load the tiles on a real rig and run `foottile calibrate`",
        )
    return find_calibration(
        name,
        serials,
        chips={tile.serial: tile.chip for tile in session.info.tiles},
        parts_seed=int(notes.get("parts_seed", 0)),
        family=_read_family(notes),
        on_progress=remark,
    )


def _read_family(notes: Mapping[str, Any]) -> PartFamily:
    """Return the part family of an emulated session; "default" if none is recorded."""
    scene = notes.get("scene")
    emulation = scene.get("emulation") if isinstance(scene, dict) else None
    named = emulation.get("family") if isinstance(emulation, dict) else None
    families: tuple[PartFamily, ...] = get_args(PartFamily)
    return next((family for family in families if family == named), "default")

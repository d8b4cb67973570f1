"""Fit of a calibration to the indentation recordings in sealed sessions.

A marker begins a step: `T01 load`: the spindle moves down on tile T01; `T01 500 g`: a weight is on
it; `soak` and `end`: no load. Other markers are remarks. A misspelt step is an error, because the
step before would be extended beyond its end.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devices.chips.pressure_chips import Compensation, get_chip
from devices.errors import CalibrationError
from devices.frames import NOT_READ, ChipRegisters, FrameBatch, hold_temperature
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.dead_weights import parse_weight
from service.estimation.effects import Parameter
from service.estimation.fitting.effects_fit import (
    DEFAULT_REFERENCE_DELAY,
    fit_determined_effects,
    separate_delays,
)
from service.estimation.fitting.rig.indentation import Indentation, select_loaded
from service.estimation.fitting.static_fit import fit_static_curve
from service.estimation.fitting.weights_fit import fit_curve_to_dead_weights, has_weights
from storage.schema import UNKNOWN_T_NS
from storage.sessions.folder import Marker
from storage.sessions.metadata import MARKERS_NAME, load_clock_table, read_existing_markers
from storage.sessions.reader import SealedFileReader

TILE_STEPS = ("rest", "load", "unload", "hold", "release", "tap")
"""Steps of a marker that begins with a tile's serial."""
IDLE_PHASES = {"soak": "soak", "end": "rest"}
"""Phase of each marker without a serial."""
_EXPECTED_FORM = (
    "SERIAL and one of "
    + ", ".join(TILE_STEPS)
    + ", or a weight such as 500 g, 4.9 N or 500 g +-0.5 %; or "
    + " or ".join(IDLE_PHASES)
)

RigProgramme = tuple[npt.NDArray[np.object_], npt.NDArray[np.str_]]
"""Programme by frame: serial of the loaded tile, or None, and phase."""


def _read_rig_programme(session: SealedFileReader) -> RigProgramme | None:
    """Read the calibration programme from a sealed session's markers; None: they have no step.

    Raises:
        CalibrationError: a marker is misspelt or has no frame.
        FileFormatError: the markers file is damaged.
    """
    try:
        events = read_existing_markers(session.path.with_name(MARKERS_NAME))
    except FileNotFoundError:
        return None
    serials, where = session.info.serials, str(session.path.parent)
    parsed = [(event, _parse_step_marker(event, serials, where)) for event in events]
    steps = sorted(((event.t_ns, step) for event, step in parsed if step is not None))
    if not steps:
        return None
    clock = load_clock_table(session)
    pieces = [
        clock.compute_server_time_columns_or_unknown(piece["t_mono_ns"], piece["t_ns"], None)[
            "t_server_ns"
        ]
        for piece in session.read_quantities("t_mono_ns", "t_ns")
    ]
    t_server_ns = np.concatenate(pieces)
    if (t_server_ns == UNKNOWN_T_NS).any():
        raise CalibrationError(
            "the markers are on the server's clock, and the node's clock was not compared with it",
            where=where,
            remedy="Record once the node's clock is measured, some seconds after it connects",
        )
    step_at = np.searchsorted([t_ns for t_ns, _ in steps], t_server_ns, side="right")
    tiles = np.array([None, *(tile or None for _, (tile, _) in steps)], dtype=object)
    phases = np.array(["rest", *(phase for _, (_, phase) in steps)], dtype=np.str_)
    return tiles[step_at], phases[step_at]


def _parse_step_marker(event: Marker, serials: Sequence[str], where: str) -> tuple[str, str] | None:
    """Parse a marker into serial (empty for none) and phase; None for a remark.

    Raises:
        CalibrationError: it resembles a step but is not one.
    """
    label = event.label.strip()
    if label in IDLE_PHASES:
        return "", IDLE_PHASES[label]
    for serial in serials:
        weight = label.removeprefix(f"{serial} ").strip()
        if weight != label and parse_weight(weight) is not None:
            return serial, weight
    serial, _, phase = (part.strip() for part in label.rpartition(" "))
    if serial in serials and phase in TILE_STEPS:
        return serial, phase
    begins = any(re.match(rf"{re.escape(known)}\b", label) for known in serials)
    if begins or phase in TILE_STEPS or label.lower() in IDLE_PHASES:
        raise CalibrationError(
            f"marker {label[:80]!r} is no calibration step",
            where=where,
            expected=f"{_EXPECTED_FORM}, of a tile of {', '.join(serials)}",
            remedy="Rename or remove it on the session's page",
        )
    return None


@dataclass(frozen=True)
class TileRecording:
    """Recording of one tile in one file, with its chip and stream."""

    indentation: Indentation
    registers: ChipRegisters
    stream_id: str
    seq_range: tuple[int, int]
    """First and last frame."""


def fit_calibration(
    recordings: Mapping[str, Sequence[TileRecording]],
    *,
    name: str,
    reference_name: str,
    reference_delay: Parameter = DEFAULT_REFERENCE_DELAY,
    on_progress: Callable[[str], None] = lambda message: None,
) -> Calibration:
    """Fit a calibration of every loaded tile.

    Repeats of a tile may be in several files, each with its own baseline and reference zero. A file
    with only a soak counts for every tile that is loaded in another file. A tile without a valid
    curve is left out, with the reason in `refused`.

    Args:
        recordings: recordings by serial.
        name: display name.
        reference_name: name of the force sensor.
        reference_delay: delay of its readings behind the force, in seconds.
        on_progress: called with the result of every tile.

    Raises:
        CalibrationError: no tile has a curve.
    """
    tiles: list[TileCalibration] = []
    refused: dict[str, str] = {}
    for number, (serial, pressed) in enumerate(recordings.items(), start=1):
        try:
            tiles.append(_fit_tile(pressed, reference_delay))
            found = _describe_fit(tiles[-1])
        except CalibrationError as error:
            if len(recordings) == 1:
                raise
            refused[serial] = str(error)
            found = "refused"
        on_progress(f"tile {serial}, {number} of {len(recordings)}: {found}")
    if not tiles:
        raise CalibrationError(
            "no tile has a curve: "
            + "; ".join(f"{serial}: {reason}" for serial, reason in refused.items())
        )
    apart = separate_delays([tile.effects for tile in tiles], reference_delay)
    tiles = [
        tile.model_copy(update={"effects": effects})
        for tile, effects in zip(tiles, apart, strict=True)
    ]
    newest_ns = max(
        int(pressed.indentation.t_ns[-1]) for all_of in recordings.values() for pressed in all_of
    )
    return Calibration(
        name=name,
        reference=reference_name,
        date=datetime.fromtimestamp(newest_ns // 1_000_000_000, tz=UTC).isoformat(),
        tiles=tuple(tiles),
        refused=refused,
    )


def read_indentations(paths: Sequence[Path]) -> dict[str, list[TileRecording]]:
    """Read every tile's recordings, by serial.

    Raises:
        FileFormatError: a file is no session.
        CalibrationError: a file is no indentation recording, a serial has two chips, or frames
            occur twice.
    """
    found: dict[str, list[TileRecording]] = {}
    for path in paths:
        with SealedFileReader(path) as session:
            chips = {tile.serial: tile.registers for tile in session.info.tiles}
            indentations, seq = _split_by_tile(session)
            for indentation in indentations:
                pressed = TileRecording(
                    indentation, chips[indentation.serial], session.info.stream_id, seq
                )
                others = found.setdefault(indentation.serial, [])
                for other in others:
                    _reject_contradiction(other, pressed)
                others.append(pressed)
    # Tiles that were only soaked have no data to fit.
    bench = {
        serial: recordings
        for serial, recordings in sorted(found.items())
        if select_loaded([pressed.indentation for pressed in recordings])
    }
    if not bench:
        raise CalibrationError(
            "no tile is loaded in any of the recordings",
            where=", ".join(str(path) for path in paths),
            expected="phases load and unload, with pressed_tile naming a tile",
        )
    return bench


def _reject_contradiction(first: TileRecording, second: TileRecording) -> None:
    serial, files = (
        first.indentation.serial,
        f"{first.indentation.where} and {second.indentation.where}",
    )
    if first.registers != second.registers:
        raise CalibrationError(
            f"tile {serial} has another chip in each of two recordings: registers "
            f"{first.registers} and {second.registers}",
            where=files,
            remedy="Give the replaced part a serial of its own, and calibrate each by itself",
        )
    # A repeat counted twice would look like good repeatability.
    if (
        first.stream_id == second.stream_id
        and first.seq_range[0] <= second.seq_range[1]
        and second.seq_range[0] <= first.seq_range[1]
    ):
        raise CalibrationError(
            f"tile {serial}: the same frames occur twice",
            where=files,
            remedy="Name each recording once",
        )


def _fit_tile(pressed: Sequence[TileRecording], delay: Parameter) -> TileCalibration:
    recordings = [each.indentation for each in pressed]
    weighted = [has_weights(recording) for recording in select_loaded(recordings)]
    if any(weighted):
        if not all(weighted):
            raise CalibrationError(
                "one recording uses dead weights, another one an indenter",
                where=", ".join(recording.where for recording in recordings),
                remedy="Calibrate from one kind of recording",
            )
        tile = fit_curve_to_dead_weights(select_loaded(recordings))
        return tile.model_copy(update={"registers": pressed[0].registers})
    tile = fit_static_curve(*select_loaded(recordings))
    return tile.model_copy(
        update={
            "registers": pressed[0].registers,
            "effects": fit_determined_effects(recordings, tile, delay),
        }
    )


def _describe_fit(tile: TileCalibration) -> str:
    """Describe a tile's fit in one line."""
    effects = tile.effects
    found = [f"curve to {tile.range_kpa[1]:.1f} kPa"]
    if (facts := tile.weights) is not None:
        last = facts.band_95[-1]
        return (
            f"{found[0]} from {len(facts.steps)} weights, "
            f"{last.force_n:.1f} +-{last.new_loading_n:.1f} N (95 %) at its end"
        )
    if (gas := effects.gas) is not None:
        found.append(f"gas {gas.gamma.value:.2f} in {1e3 * gas.tau_s.value:.0f} ms")
    if (rubber := effects.rubber) is not None:
        terms = zip(rubber.part, rubber.tau_s, strict=True)
        each = (f"{100 * part.value:.1f} % in {tau.value:.2g} s" for part, tau in terms)
        found.append("creep " + " and ".join(each))
    if (loop := effects.hysteresis) is not None:
        flows = "" if loop.flow is None else f", {loop.flow.stress_n.value:.2f} N of it flows"
        found.append(f"loop{flows}")
    if (warm := effects.temperature) is not None:
        found.append(f"{warm.kpa_per_k.value:.3f} kPa/K")
    return ", ".join([*found, *(f"no {name}" for name in effects.refused)])


def _read_marked_programme(session: SealedFileReader) -> RigProgramme:
    """Read the programme from the markers of a server's recording.

    Raises:
        CalibrationError: there is none, or the recording has a gap.
    """
    notes = session.notes.get("session")
    if isinstance(notes, dict) and len(notes.get("parts") or ()) > 1:
        raise CalibrationError(
            "the node was restarted while it was recorded",
            where=str(session.path),
            expected="a recording in one part",
            remedy="Record again",
        )
    marked = _read_rig_programme(session)
    if marked is None:
        raise CalibrationError(
            "not an indentation recording",
            where=str(session.path),
            expected="columns pressed_tile and phase beside reference_force_n, or markers such as "
            "`T01 load`",
            remedy="Record one with a rig, or `foottile simulate --scene indentation`",
        )
    return marked


def _split_by_tile(session: SealedFileReader) -> tuple[list[Indentation], tuple[int, int]]:
    """Split a rig recording by tile; also return its first and last seq."""
    has_columns = session.has_columns("pressed_tile", "phase")
    marked = None if has_columns else _read_marked_programme(session)
    pieces = list(session.read_batches(*(("pressed_tile", "phase") if has_columns else ())))
    frames = FrameBatch.concatenate([frames for frames, _ in pieces])
    if marked is None:
        pressed = np.concatenate([extra["pressed_tile"] for _, extra in pieces])
        phase = np.concatenate([extra["phase"] for _, extra in pieces]).astype(np.str_)
    else:
        pressed, phase = marked
    # A recording with only a soak counts for all tiles.
    only_soak = bool((phase == "soak").any()) and not np.isin(pressed, session.info.serials).any()
    held, _ = hold_temperature(frames)
    compensation = Compensation(session.info.tiles)
    readable_kpa = compensation.compute_usable_kpa(held)
    # A count that wrapped around reads as almost no pressure (model `unwrap`): the tile was
    # loaded beyond its chip's range. Of a chip whose counts do not wrap it is no pressure.
    below_kpa = np.where(compensation.wrap_counts > 0, np.inf, np.nan)
    kpa = np.where(readable_kpa < compensation.min_kpa, below_kpa, readable_kpa)
    # Tiles that convert on command are sampled together, with the reference; others in between.
    free = [get_chip(tile.chip).is_free_running(tile.settings) for tile in session.info.tiles]
    later_ns = np.where(free, 1000 * frames.sample_offset_us.astype(np.int64), 0)
    read_s, force_n = (frames.t_ns - frames.t_ns[0]) * 1e-9, frames.reference_force_n.astype(float)
    tiles = [
        Indentation(
            serial=tile.serial,
            chip=get_chip(tile.chip),
            where=str(session.path),
            t_ns=frames.t_ns + later_ns[:, i],
            kpa=kpa[:, i],
            reference_n=np.interp(read_s + 1e-9 * later_ns[:, i], read_s, force_n)
            if later_ns[:, i].any()
            else force_n,
            phase=phase,
            is_under_indenter=pressed == tile.serial,
            temperature_raw=np.where(
                held.temperature_raw[:, i] == NOT_READ,
                np.nan,
                held.temperature_raw[:, i].astype(np.float64),
            ),
        )
        for i, tile in enumerate(session.info.tiles)
        if (pressed == tile.serial).any() or only_soak
    ]
    if not tiles:
        raise CalibrationError(
            "no tile of the array is loaded in the recording",
            where=str(session.path),
            expected="pressed_tile naming one of " + ", ".join(session.info.serials),
        )
    return tiles, (int(frames.seq[0]), int(frames.seq[-1]))

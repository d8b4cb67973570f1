"""From indentation recordings to a calibration: reads sealed sessions, fits each tile."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from devices.compensation import Compensation
from devices.errors import CalibrationError
from devices.frames import NOT_READ, FrameBatch
from devices.temperature import hold_temperature
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.effects_fit import fit_effects
from service.estimation.fit import fit_tile
from service.estimation.indentation import Indentation
from storage.session_file import SessionReader


def calibrate(paths: Sequence[Path], *, name: str, reference: str) -> Calibration:
    """Fit every tile that was pressed in the recordings.

    Args:
        paths: sealed sessions with `reference_force_n`, `pressed_tile` and `phase`.
        name: for people.
        reference: the force sensor.

    Raises:
        FileFormatError: a file is no such recording.
        CalibrationError: no tile was pressed, one was pressed in two files, or a fit fails.
    """
    recordings: dict[str, Indentation] = {}
    chips: dict[str, tuple[int, int, int, int]] = {}
    newest_ns = 0
    for path in paths:
        with SessionReader(path) as session:
            chips |= {tile.serial: tile.coefficient_words for tile in session.info.tiles}
            for recording in read_indentations(session):
                if recording.serial in recordings:
                    raise CalibrationError(
                        f"tile {recording.serial} is pressed in "
                        f"{recordings[recording.serial].where} and in {recording.where}",
                        remedy="Calibrate from one recording per tile",
                    )
                recordings[recording.serial] = recording
                newest_ns = max(newest_ns, int(recording.t_ns[-1]))
    return Calibration(
        name=name,
        reference=reference,
        date=datetime.fromtimestamp(newest_ns // 1_000_000_000, tz=UTC).isoformat(),
        tiles=tuple(_fitted(recordings[serial], chips[serial]) for serial in sorted(recordings)),
    )


def _fitted(recording: Indentation, chip: tuple[int, int, int, int]) -> TileCalibration:
    tile = fit_tile(recording)
    return tile.model_copy(
        update={"coefficient_words": chip, "effects": fit_effects(recording, tile)}
    )


def read_indentations(session: SessionReader) -> list[Indentation]:
    """Every tile's part of a bench recording.

    Raises:
        CalibrationError: it is not one: a column is missing, or no tile was pressed.
    """
    if not session.has("pressed_tile", "phase"):
        raise CalibrationError(
            "not an indentation recording",
            where=str(session.path),
            expected="columns pressed_tile and phase beside reference_force_n",
            remedy="Record one with the mill, or `foottile simulate --scene indentation`",
        )
    pieces = list(session.batches("pressed_tile", "phase"))
    frames = FrameBatch.concatenate([frames for frames, _ in pieces])
    pressed = np.concatenate([extra["pressed_tile"] for _, extra in pieces])
    phase = np.concatenate([extra["phase"] for _, extra in pieces]).astype(np.str_)
    held, _ = hold_temperature(frames)
    kpa = Compensation(session.info.tiles).readable_kpa(held)
    tiles = [
        Indentation(
            serial=serial,
            where=str(session.path),
            t_ns=frames.t_ns,
            kpa=kpa[:, i],
            reference_n=frames.reference_force_n.astype(np.float64),
            phase=phase,
            under_spindle=pressed == serial,
            tadc=np.where(held.tadc[:, i] == NOT_READ, np.nan, held.tadc[:, i].astype(np.float64)),
        )
        for i, serial in enumerate(session.info.serials)
        if (pressed == serial).any()
    ]
    if not tiles:
        raise CalibrationError(
            "no tile of the array is pressed in the recording",
            where=str(session.path),
            expected="pressed_tile naming one of " + ", ".join(session.info.serials),
        )
    return tiles

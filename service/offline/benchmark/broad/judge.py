"""Evaluation of one recording's estimates for the result file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.chips.mpl115a2 import PRESSURE_MAX_KPA
from devices.emulation.world import World
from service.estimation.estimates import INTERVAL_95, EstimateStatus
from service.offline.accuracy import COMPARED, PHASES, accuracy_of, phases_of
from service.offline.benchmark.broad.results import Judged, Phase
from service.offline.benchmark.draws import Recording

JUDGED = (*COMPARED, "force_n", "force_sigma_n", "true_force_n")
WRONG_TILE = (EstimateStatus.STUCK, EstimateStatus.CLIPPED, EstimateStatus.BASELINE_LOST)
"""Flags of tiles that answer but are faulty."""
NOISES = 4.0
"""Distance of the settled pressure below the calibrated end, in standard deviations of a reading,
from which a saturation flag is wrong."""


def judged(
    columns: Mapping[str, npt.NDArray[Any]],
    below_end: Callable[[], npt.NDArray[np.bool_]],
    lag_ms: float,
) -> Judged:
    """Compute errors, coverage and flag counts.

    Args:
        columns: `JUDGED` of every frame of the recording.
        below_end: returns `surely_below_end`, (n, tiles); called only if needed,
            because it takes as long as the recording.
        lag_ms: look-ahead of the estimates.
    """
    accuracy = accuracy_of({name: columns[name] for name in COMPARED}, lag_ms=lag_ms)
    status = columns["estimate_status"]
    error_n = columns["grf_n"] - columns["true_grf_n"]
    sigma_n = columns["grf_sigma_n"]
    usable = ((status & EstimateStatus.SATURATED) == 0) & np.isfinite(error_n)
    phases = phases_of(columns["t_ns"], columns["true_grf_n"])
    covered = np.abs(error_n) <= INTERVAL_95 * sigma_n
    # A lower bound has no sigma.
    bounds = np.isfinite(columns["force_n"]) & ~np.isfinite(columns["force_sigma_n"])
    held = columns["true_force_n"] >= columns["force_n"]
    return Judged(
        frames=accuracy.frames,
        grf_mae_n=known(accuracy.grf_mae_n),
        peak_error_n=known(accuracy.peak_error_n),
        cop_p95_m=known(accuracy.cop_p95_m),
        flight_mean_n=known(accuracy.flight_mean_n),
        phases={
            name: Phase(
                frames=int(rows.sum()),
                within=int((rows & covered).sum()),
                sigma2=float((sigma_n[rows] ** 2).sum()),
                error2=float((error_n[rows] ** 2).sum()),
            )
            for i, name in enumerate(PHASES)
            for rows in (usable & (phases == i),)
        },
        cop_frames=accuracy.cop_covered.frames,
        cop_within=accuracy.cop_covered.within,
        saturated_frames=accuracy.saturated_frames,
        saturated_tile_frames=int(bounds.sum()),
        wrongly=int((bounds & below_end()).sum()) if bounds.any() else 0,
        held=int((bounds & held).sum()),
        grf_bounds=accuracy.bounds.frames,
        grf_bounds_held=accuracy.bounds.within,
        after_frames=accuracy.after_saturation.frames,
        after_within=accuracy.after_saturation.within,
        after_saturation_mae_n=known(accuracy.after_saturation_mae_n),
        seconds=float(columns["t_ns"][-1] - columns["t_ns"][0]) * 1e-9,
        alarms=_alarms(status),
    )


def _alarms(status: npt.NDArray[np.uint16]) -> int:
    """Count the onsets of `WRONG_TILE`."""
    return sum(
        int((np.diff((status & bit) != 0, prepend=False) & ((status & bit) != 0)).sum())
        for bit in WRONG_TILE
    )


def surely_below_end(recording: Recording, world: World) -> npt.NDArray[np.bool_]:
    """Return which tiles are surely within calibration and chip range, (n, tiles)."""
    t_ns = recording.frames.t_mono_ns
    doubt_kpa = NOISES * world.scene.emulation.noise_kpa
    unloaded_kpa = np.array([part.seal_kpa for part in world.domes])
    settled_kpa = world.dome_kpa(t_ns, ("gas", "surroundings")) - unloaded_kpa
    return np.asarray(
        (settled_kpa < _ends_kpa(recording) - doubt_kpa)
        & (world.dome_kpa(t_ns) < PRESSURE_MAX_KPA - doubt_kpa)
    )


def _ends_kpa(recording: Recording) -> Floats:
    """Return each tile's calibrated gauge pressure range end; infinite for a bare tile."""
    return np.array(
        [
            math.inf if tile.reference else recording.calibration.of(tile.serial).range_kpa[1]
            for tile in recording.info.tiles
        ]
    )


def known(value: float) -> float | None:
    """Return the number, or None for NaN."""
    return value if math.isfinite(value) else None

"""From the estimates of one recording to what is kept of them."""

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
"""Flags of tiles that answer and are wrong."""
NOISES = 4.0
"""A tile whose settled pressure is that many standard deviations of a reading below the end of its
calibration was called saturated wrongly."""


def judged(
    columns: Mapping[str, npt.NDArray[Any]],
    below_end: Callable[[], npt.NDArray[np.bool_]],
    lag_ms: float,
) -> Judged:
    """Errors, coverage and flags.

    Args:
        columns: `JUDGED`, of every frame of the recording.
        below_end: gives what `surely_below_end` says, (n, tiles); asked only if it matters, since
            that takes as long as the recording did.
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
    """How often one of `WRONG_TILE` comes on."""
    return sum(
        int((np.diff((status & bit) != 0, prepend=False) & ((status & bit) != 0)).sum())
        for bit in WRONG_TILE
    )


def surely_below_end(recording: Recording, world: World) -> npt.NDArray[np.bool_]:
    """Which tiles are within their calibration and their chip's range beyond doubt, (n, tiles)."""
    t_ns = recording.frames.t_mono_ns
    doubt_kpa = NOISES * world.scene.emulation.noise_kpa
    unloaded_kpa = np.array([part.seal_kpa for part in world.domes])
    settled_kpa = world.dome_kpa(t_ns, ("gas", "surroundings")) - unloaded_kpa
    return np.asarray(
        (settled_kpa < _ends_kpa(recording) - doubt_kpa)
        & (world.dome_kpa(t_ns) < PRESSURE_MAX_KPA - doubt_kpa)
    )


def _ends_kpa(recording: Recording) -> Floats:
    """Where each tile's calibration ends, gauge; of a bare tile nowhere."""
    return np.array(
        [
            math.inf if tile.reference else recording.calibration.of(tile.serial).range_kpa[1]
            for tile in recording.info.tiles
        ]
    )


def known(value: float) -> float | None:
    """A number, if it is one."""
    return value if math.isfinite(value) else None

"""Everything an estimate needs to know before the first frame, worked out once.

A scene says which models it needs and only those are computed; what is not named costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.compensation import Compensation
from devices.errors import CalibrationError, UsageError
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.estimation.contact import ContactRule
from service.estimation.geometry import grid_indices, hull
from service.estimation.models.static import StaticCurves
from service.estimation.tare import Tare

Floats = npt.NDArray[np.float64]

MODELS = ("unwrap", "static")

CONTACT_ON_SIGMA = 5.0
CONTACT_OFF_SIGMA = 3.0
CONTACT_MIN_NS = 10_000_000
SIGMAS = 5.0
"""COP needs a GRF of so many sigma: below, the first-order variance of a ratio is not valid. And a
pressure so many sigma below the calibrated range is no noise."""
COP_SIGMA_MAX_M = 0.003
TARE_OLD_NS = 1_800_000_000_000
"""Half an hour: at the 0.3 kPa/K of a sealed bubble a degree in that time is half a newton."""
LAG_MAX_MS = 60_000.0
GAP = 1.5
"""A frame this many nominal periods after the one before comes after a gap."""


@dataclass(frozen=True)
class EstimationPlan:
    """Constants of one estimate of one stream; arrays over tiles. Made by `make_plan`."""

    info: ArrayInfo
    calibration: Calibration
    tare: Tare
    models: tuple[str, ...]
    lag_ns: int
    compensation: Compensation
    curves: StaticCurves
    bears: npt.NDArray[np.bool_]
    """False for bare reference tiles, which are in no sum."""
    positions_m: Floats
    hull: tuple[Floats, Floats]
    grid: tuple[Floats, Floats] | None
    contact: ContactRule
    assumed_scale: bool
    gap_ns: int
    cop_sigma_max_m: float = COP_SIGMA_MAX_M


def make_plan(
    info: ArrayInfo,
    calibration: Calibration,
    tare: Tare,
    *,
    models: Sequence[str],
    lag_ms: float = 0.0,
) -> EstimationPlan:
    """Work out an estimate's constants.

    Args:
        info: the array.
        calibration: of all its tiles, or a preset for any.
        tare: of this recording.
        models: names of `MODELS`, in any order; `static` must be among them.
        lag_ms: look-ahead: estimates come this much later and know that much more.

    Raises:
        UsageError: an unknown model, no `static`, or a negative lag.
        CalibrationError: a tile is not calibrated.
    """
    check_models(models)
    if not 0.0 <= lag_ms <= LAG_MAX_MS:
        raise UsageError(f"a look-ahead of {lag_ms} ms", expected=f"0 to {LAG_MAX_MS:g} ms")
    if all(tile.reference for tile in info.tiles):
        raise UsageError("every tile of the array is a reference tile: nothing bears load")
    entries = [calibration.of(tile.serial) for tile in info.tiles]
    for tile, entry in zip(info.tiles, entries, strict=True):
        if entry.coefficient_words not in (None, tile.coefficient_words):
            raise CalibrationError(
                f"tile {tile.serial} is not the part that was calibrated: its chip has the "
                f"coefficients {tile.coefficient_words}, the calibrated one "
                f"{entry.coefficient_words}",
                where=f"calibration {calibration.name} ({calibration.id})",
                remedy="Press this tile on the bench and calibrate it, or correct the serial",
            )
    curves = StaticCurves(entries)
    bears = np.array([not tile.reference for tile in info.tiles])
    positions_m = np.array([(tile.x_m, tile.y_m, tile.z_m) for tile in info.tiles])
    still_kpa = np.hypot(tare.noise_kpa, tare.baseline_sigma_kpa)
    unloaded_n = float(np.sqrt(((curves.slope_at_zero_n_per_kpa * still_kpa)[bears] ** 2).sum()))
    return EstimationPlan(
        info=info,
        calibration=calibration,
        tare=tare,
        models=tuple(name for name in MODELS if name in models),
        lag_ns=round(lag_ms * 1e6),
        compensation=Compensation(info.tiles),
        curves=curves,
        bears=bears,
        positions_m=positions_m,
        hull=hull(positions_m[bears, :2]),
        grid=grid_indices(positions_m[bears, :2]),
        contact=ContactRule(
            on_n=CONTACT_ON_SIGMA * unloaded_n,
            off_n=CONTACT_OFF_SIGMA * unloaded_n,
            min_ns=CONTACT_MIN_NS,
        ),
        assumed_scale=any(entry.absolute_scale == "assumed" for entry in entries),
        gap_ns=round(GAP * 1e9 / info.nominal_rate_hz),
    )


def check_models(models: Sequence[str]) -> None:
    """Refuse models that there are not, and a ladder without force.

    Raises:
        UsageError: an unknown model, or no `static`.
    """
    for name in models:
        if name not in MODELS:
            raise UsageError(f"unknown model {name!r}", expected=f"some of {', '.join(MODELS)}")
    if "static" not in models:
        raise UsageError("without the model 'static' there is no force", remedy="Add it")

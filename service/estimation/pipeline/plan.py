"""Estimation plan: everything that an estimate needs before the first frame.

Only the models that a scene names are computed; the others cost nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Ints
from devices.chips.compensation import Compensation
from devices.chips.mpl115a2 import PRESSURE_MAX_KPA
from devices.errors import CalibrationError, UsageError
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.effects import Parameter
from service.estimation.fault_detection.fault_limits import FaultLimits, make_fault_limits
from service.estimation.foot.contact import ContactThresholds
from service.estimation.foot.geometry import (
    HalfPlanes,
    compute_grid_indices_from_1,
    compute_hull_half_planes,
    compute_tilt_loss,
    fit_tile_axis_angles_rad,
)
from service.estimation.models import denoise
from service.estimation.pipeline.model_set import MODEL_NAMES, ModelSet, make_checked_model_set
from service.estimation.pipeline.saturation import SaturationBounds, make_saturation_bounds
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import compute_variance_inflation

CONTACT_ON_SIGMA = 5.0  # of the GRF unloaded: noise alone does not get there
CONTACT_OFF_SIGMA = 3.0  # lower than on, so that noise about a threshold does not chatter
CONTACT_MIN_NS = 10_000_000  # a shorter change is an outlier or a bounce
SIGNIFICANCE_SIGMAS = 5.0
"""Least GRF for a COP, in its sigmas: below, the first-order variance of a ratio is invalid. Also
the distance below the calibrated range that noise does not explain."""
SUCTION_MAX_KPA = 10.0
"""Largest pressure below the baseline that can be a force: no foot pulls a dome that much, and 30 K
make less. Beyond, a count wrapped far, a dome is torn, or there is another fault."""
COP_SIGMA_MAX_M = 0.003  # a quarter of a dome: worse does not locate the load
TARE_OLD_NS = 1_800_000_000_000
"""Age at which a tare is old: half an hour. At 0.3 kPa/K a degree in it is half a newton."""
LAG_MAX_MS = 60_000.0  # frames stay in memory for that time
SETTLING_TIME_CONSTANTS = 5.0
"""Time constants until models have settled; less than a hundredth of the initial error remains."""
SETTLING_MIN_S = 10.0
"""Settling time of models without a time constant: noise, contact, zero-order holds."""
GAP_PERIODS = 1.5
"""Least distance of two frames with a gap between them, in nominal periods."""


@dataclass(frozen=True)
class EstimationPlan:
    """Parameters of one estimate of one stream; arrays over tiles. Made by `make_plan`."""

    info: ArrayInfo
    calibration: Calibration
    tare: Tare
    models: tuple[str, ...]
    lag_ns: int
    compensation: Compensation
    model_set: ModelSet
    load_bearing_columns: npt.NDArray[np.intp]
    """Columns of the load-bearing tiles; arrays below are over these, unless stated."""
    reference_columns: npt.NDArray[np.intp]
    """Columns of bare reference tiles, which no sum contains."""
    baseline_kpa: Floats
    baseline_sigma_kpa: Floats
    noise_kpa: Floats
    variance_inflation: Floats
    """(tiles, n), variance of a mean of n readings over that of white noise."""
    sample_delay_ns: Ints
    """Delay of a tile's samples behind the instants in its frames."""
    sample_delay_sigma_s: Floats
    """Standard uncertainty of the delay, independent between tiles."""
    sample_delay_common_sigma_s: Floats
    """Standard uncertainty of the delay that all tiles share."""
    chip_max_kpa: Floats
    """Absolute pressure above which a chip saturates: the end of its rated range, or the highest
    pressure in the rig, if that was higher or the chip saturated there."""
    saturation: SaturationBounds
    fault_limits: FaultLimits | None
    """None: no fault detection, for benchmarks."""
    unloaded_sigma_kpa: Floats
    """Standard deviation of a single unloaded reading about the true baseline."""
    tile_positions_m: Floats
    """(tiles, 3), positions of the tiles."""
    cop_measured: tuple[bool, bool]
    """Measurement of the centre of pressure along x, and along y; False across a row of tiles."""
    mount_gain: Floats
    """Newtons of the ground on a tile's part of the foot for a newton of the dome."""
    mount_gain_sigma: Floats
    axis_rad: Floats
    """Angle of a tile's axis to the segment."""
    tilt_loss: Floats
    """Part of a tile's force that is not along the segment, by the angle of its axis."""
    shear: Parameter | None
    """Direction of the ground's force on tiles that are not upright; None: unknown."""
    hull: HalfPlanes
    grid: tuple[Floats, Floats] | None
    contact: ContactThresholds
    is_scale_assumed: bool
    gap_ns: int
    cop_sigma_max_m: float = COP_SIGMA_MAX_M

    @property
    def waits_for_next(self) -> bool:
        """True if every frame waits for the next one, for outlier replacement."""
        return self.model_set.has_denoise and self.lag_ns > 0

    @property
    def lookahead_ns(self) -> int:
        """Look-ahead of windows; 1 ns shorter if frames wait for the next one."""
        return self.lag_ns - 1 if self.waits_for_next else self.lag_ns


def make_plan(
    info: ArrayInfo,
    calibration: Calibration,
    tare: Tare,
    *,
    models: Sequence[str],
    lag_ms: float = 0.0,
) -> EstimationPlan:
    """Compute an estimate's parameters.

    Args:
        info: the array.
        calibration: of all its tiles, or a preset for any.
        tare: of this recording.
        models: names of `MODEL_NAMES`, in any order; `static` must be among them.
        lag_ms: look-ahead, by which estimates are delayed.

    Raises:
        UsageError: an unknown model, no `static`, `ambient` without a bare tile, or a bad lag.
        CalibrationError: a bearing tile is not calibrated, or not for one of the models.
    """
    if not 0.0 <= lag_ms <= LAG_MAX_MS:
        raise UsageError(f"a look-ahead of {lag_ms} ms", expected=f"0 to {LAG_MAX_MS:g} ms")
    bearing = np.flatnonzero([not tile.reference for tile in info.tiles])
    if not len(bearing):
        raise UsageError("every tile of the array is a reference tile: nothing bears load")
    model_set = make_checked_model_set(info, calibration, tare, models)
    entries = calibration.get_tiles_or_wildcard([info.tiles[i].serial for i in bearing])
    for i, entry in zip(bearing, entries, strict=True):
        tile = info.tiles[i]
        if entry.coefficient_words not in (None, tile.coefficient_words):
            raise CalibrationError(
                f"tile {tile.serial} is not the part that was calibrated: its chip has the "
                f"coefficients {tile.coefficient_words}, the calibrated one "
                f"{entry.coefficient_words}",
                where=f"calibration {calibration.name} ({calibration.id})",
                remedy="Press this tile on the test rig and calibrate it, or correct the serial",
            )
    positions_m = np.array([(tile.x_m, tile.y_m, tile.z_m) for tile in info.tiles])
    baseline_kpa = tare.baseline_kpa[bearing]
    chip_end_kpa = np.array(
        [_compute_chip_max_kpa(*each) for each in zip(entries, baseline_kpa.tolist(), strict=True)]
    )
    still_kpa = np.hypot(tare.noise_kpa, tare.baseline_sigma_kpa)[bearing]
    unloaded_n = float(
        np.sqrt(((model_set.static_curves.slope_at_zero_n_per_kpa * still_kpa) ** 2).sum())
    )
    gains = [calibration.find_mount_gain(info.tiles[i].serial) for i in bearing]
    axis_rad = fit_tile_axis_angles_rad(positions_m[bearing])
    return EstimationPlan(
        info=info,
        calibration=calibration,
        tare=tare,
        models=tuple(name for name in MODEL_NAMES if name in models),
        lag_ns=round(lag_ms * 1e6),
        compensation=Compensation(info.tiles),
        model_set=model_set,
        load_bearing_columns=bearing,
        reference_columns=np.flatnonzero([tile.reference for tile in info.tiles]),
        baseline_kpa=baseline_kpa,
        baseline_sigma_kpa=tare.baseline_sigma_kpa[bearing],
        noise_kpa=tare.noise_kpa[bearing],
        variance_inflation=_compute_variance_inflation(tare, bearing, info.nominal_rate_hz),
        sample_delay_ns=np.array(
            [
                round(1e9 * late.value) if (late := e.effects.late_s) is not None else 0
                for e in entries
            ],
            dtype=np.int64,
        ),
        sample_delay_sigma_s=np.array(
            [late.sigma if (late := e.effects.late_s) is not None else 0.0 for e in entries]
        ),
        sample_delay_common_sigma_s=np.array([e.effects.late_common_s for e in entries]),
        chip_max_kpa=chip_end_kpa,
        saturation=make_saturation_bounds(
            model_set.static_curves, model_set.gas, baseline_kpa, chip_end_kpa
        ),
        fault_limits=make_fault_limits(
            info,
            calibration,
            tare,
            chip_end_kpa,
            is_gas_corrected=model_set.is_gas_known & (model_set.gas is not None),
            has_thermal_drift=model_set.temperature is None,
        ),
        unloaded_sigma_kpa=still_kpa,
        tile_positions_m=positions_m[bearing],
        cop_measured=(info.row_place_m[0] is None, info.row_place_m[1] is None),
        mount_gain=np.array([1.0 if gain is None else gain.value for gain in gains]),
        mount_gain_sigma=np.array([0.0 if gain is None else gain.sigma for gain in gains]),
        axis_rad=axis_rad,
        tilt_loss=compute_tilt_loss(axis_rad),
        shear=None if calibration.mounted is None else calibration.mounted.shear,
        hull=compute_hull_half_planes(positions_m[bearing, :2]),
        grid=compute_grid_indices_from_1(positions_m[bearing, :2]),
        contact=ContactThresholds(
            on_n=CONTACT_ON_SIGMA * unloaded_n,
            off_n=CONTACT_OFF_SIGMA * unloaded_n,
            min_ns=CONTACT_MIN_NS,
        ),
        is_scale_assumed=calibration.has_assumed_scale([info.tiles[i].serial for i in bearing]),
        gap_ns=round(GAP_PERIODS * 1e9 / info.nominal_rate_hz),
    )


def _compute_variance_inflation(
    tare: Tare, bearing: npt.NDArray[np.intp], rate_hz: float
) -> Floats:
    readings = np.arange(denoise.WINDOW_READINGS_MAX + 1)
    if tare.noise_lasting is None or tare.noise_lasting_s is None:
        return np.ones((len(bearing), len(readings)))
    part, lasts_s = tare.noise_lasting[bearing, None], tare.noise_lasting_s[bearing, None]
    return compute_variance_inflation(part, lasts_s * rate_hz, np.maximum(readings, 1))


def _compute_chip_max_kpa(entry: TileCalibration, baseline_kpa: float) -> float:
    facts = entry.rig
    if facts is None:
        return max(PRESSURE_MAX_KPA, baseline_kpa + entry.range_kpa[1])
    if facts.ended_by == "chip":
        return facts.end_absolute_kpa
    return max(PRESSURE_MAX_KPA, facts.end_absolute_kpa)


def compute_settling_time_s(plan: EstimationPlan) -> float:
    """Return the time in seconds until the models have settled."""
    model_set, longest_s = plan.model_set, 0.0
    if model_set.gas is not None:
        longest_s = max(longest_s, float((model_set.gas.gamma * model_set.gas.tau_s).max()))
    if model_set.rubber is not None:
        longest_s = max(
            longest_s, float(model_set.rubber.tau_s[model_set.rubber.creep_fraction > 0.0].max())
        )
    if model_set.temperature is not None:
        longest_s = max(longest_s, float(np.abs(model_set.temperature.lag_s).max()))
    return max(SETTLING_MIN_S, SETTLING_TIME_CONSTANTS * longest_s)

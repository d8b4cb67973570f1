"""Estimation plan: everything that an estimate needs before the first frame.

Only the models that a scene names are computed; the others cost nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.chips.pressure_chips import Compensation
from devices.errors import CalibrationError, UsageError
from devices.frames import ArrayInfo, TileInfo
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.fault_detection.fault_limits import make_fault_params
from service.estimation.foot import (
    compute_grid_indices_from_1,
    compute_hull_half_planes,
    compute_segment_rad_per_count,
    compute_tilt_loss,
    fit_tile_axis_angles_rad,
)
from service.estimation.models import LoadBearingTiles, denoise, rubber
from service.estimation.models.static import StaticParams
from service.estimation.pipeline.params import (
    MODELS,
    FootParams,
    KernelParams,
    TileParams,
    make_model_params,
)
from service.estimation.pipeline.saturation import make_saturation_params
from service.estimation.records import RecordArray
from service.estimation.tare.tare import (
    UNLOADED_SIGMA_MIN_KPA,
    Tare,
    compute_temperature_change_max_counts,
)
from service.estimation.tare.unloaded_windows import compute_variance_inflation

CONTACT_ON_SIGMA = 5.0  # of the GRF unloaded: noise alone does not get there
CONTACT_OFF_SIGMA = 3.0  # lower than on, so that noise about a threshold does not chatter
CONTACT_ON_SHARE = 0.02
"""Share of the greatest recent force at which contact begins; it ends at half of that. Corrections
of creep and loop leave less of a load."""
CONTACT_ON_SHARE_CREEP = 0.1
"""Share without the model `rubber`: domes creep by 2 to 15 % of a load."""
CONTACT_MIN_NS = 10_000_000  # a shorter change is an outlier or a bounce
SIGNIFICANCE_SIGMAS = 5.0
"""Least GRF for a COP, in its sigmas: below, the first-order variance of a ratio is invalid. Also
the distance below the calibrated range that noise does not explain."""
UNLOADED_MAX_SIGMAS = 3.0
"""Largest first reading of an unloaded tile, in sigmas: it has borne nothing. Noise alone exceeds
it once in 700, and sigma is then a little larger than it need be."""
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
    """Parameters of one estimate of one stream. Made by `make_plan`."""

    info: ArrayInfo
    calibration: Calibration
    tare: Tare
    models: tuple[str, ...]
    lag_ns: int
    load_bearing_columns: npt.NDArray[np.intp]
    cop_measured: tuple[bool, bool]
    """Measurement of the centre of pressure along x, and along y; False across a row of tiles."""
    params: KernelParams

    @property
    def load_bearing_params(self) -> RecordArray[TileParams]:
        """Parameters of the load-bearing tiles."""
        found: RecordArray[TileParams] = np.asarray(self.params.tiles)[self.load_bearing_columns]
        return found

    @property
    def curves(self) -> RecordArray[StaticParams]:
        """Static curves of the load-bearing tiles; of settled forces if `rubber` is used."""
        found: RecordArray[StaticParams] = self.params.tiles["static"][self.load_bearing_columns]
        return found

    @property
    def is_scale_assumed(self) -> bool:
        """True if the newtons of a tile rest on an assumption."""
        return bool(self.params.foot["is_scale_assumed"][0])

    @property
    def lookahead_ns(self) -> int:
        """Look-ahead of windows; 1 ns shorter if frames wait for the next one."""
        return int(self.params.foot["lookahead_ns"][0])


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
    entries = calibration.get_tiles_or_wildcard([info.tiles[i].serial for i in bearing])
    compensation = Compensation(info.tiles)
    model_inputs = LoadBearingTiles(
        calibrations=entries,
        calibration_label=f"calibration {calibration.name} ({calibration.id})",
        models=models,
        baseline_kpa=tare.baseline_kpa[bearing],
        tare_counts=tare.temperature_raw_counts[bearing],
        counts_per_kelvin=compensation.counts_per_kelvin[bearing],
        temperature_noise_counts=compensation.temperature_noise_counts[bearing],
        rated_max_kpa=compensation.max_kpa[bearing],
        step_s=1.0 / info.nominal_rate_hz,
        has_bare_tile=len(bearing) < len(info.tiles),
    )
    by_model = make_model_params(model_inputs)
    for i, entry in zip(bearing, entries, strict=True):
        _reject_other_part(info.tiles[i], entry, model_inputs.calibration_label)
    tiles = TileParams.array(len(info.tiles))
    tiles[bearing] = _make_bearing_params(info, calibration, tare, bearing, model_inputs, by_model)
    faults, equal_count_limits = make_fault_params(
        info,
        compensation,
        calibration,
        tare,
        tiles["chip_max_kpa"][bearing],
        is_gas_corrected=tiles["gas"]["is_known"][bearing] == 1,
    )
    of_all = {
        **vars(compensation.law),
        "rated_min_kpa": compensation.min_kpa,
        "rated_max_kpa": compensation.max_kpa,
        "wrap_counts": compensation.wrap_counts,
        "temperature_change_max_counts": compute_temperature_change_max_counts(
            compensation.counts_per_kelvin
        ),
        "baseline_kpa": tare.baseline_kpa,
        "noise_kpa": tare.noise_kpa,
        "tare_counts": tare.temperature_raw_counts,
        "faults": faults,
    }
    for name, column in of_all.items():
        tiles[name] = column
    for name in by_model:
        tiles[name]["is_used"] = 1
    normals, offsets_m = compute_hull_half_planes(tiles["position_m"][bearing, :2])
    foot = _make_foot_params(info, calibration, tare, models, round(lag_ms * 1e6))
    foot["equal_count_limits"] = equal_count_limits
    foot["variance_inflation"] = tiles["variance_inflation"][bearing].mean(axis=0)
    still_n = (
        tiles["static"]["slope_at_zero_n_per_kpa"][bearing]
        * _compute_unloaded_sigma_kpa(tare)[bearing]
    )
    unloaded_n = float(np.sqrt((still_n**2).sum()))
    foot["contact_on_n"] = CONTACT_ON_SIGMA * unloaded_n
    foot["contact_off_n"] = CONTACT_OFF_SIGMA * unloaded_n
    foot["contact_bound_n"] = CONTACT_ON_SIGMA * unloaded_n * tiles["mount_gain"][bearing].max()
    foot["has_grid"] = (tiles["grid_index"][bearing] > 0.0).all()
    return EstimationPlan(
        info=info,
        calibration=calibration,
        tare=tare,
        models=tuple(by_model),
        lag_ns=round(lag_ms * 1e6),
        load_bearing_columns=bearing,
        cop_measured=(info.row_place_m[0] is None, info.row_place_m[1] is None),
        params=KernelParams(
            foot, tiles, np.ascontiguousarray(np.column_stack([normals, offsets_m]))
        ),
    )


def _reject_other_part(tile: TileInfo, entry: TileCalibration, where: str) -> None:
    """Reject the calibration of another chip than the tile's."""
    if entry.registers not in (None, tile.registers):
        raise CalibrationError(
            f"tile {tile.serial} is not the part that was calibrated: its chip has the "
            f"registers {tile.registers}, the calibrated one {entry.registers}",
            where=where,
            remedy="Press this tile on the test rig and calibrate it, or correct the serial",
        )


def _make_foot_params(
    info: ArrayInfo, calibration: Calibration, tare: Tare, models: Sequence[str], lag_ns: int
) -> RecordArray[FootParams]:
    """Make the parameters that no tile is needed for."""
    has_denoise, serials = "denoise" in models, [t.serial for t in info.tiles if not t.reference]
    # With look-ahead and averages, a frame waits for the next one. Without look-ahead the next
    # frame is not there, and may be of the same instant.
    waits_for_next = has_denoise and lag_ns > 0
    on_share = CONTACT_ON_SHARE if "rubber" in models else CONTACT_ON_SHARE_CREEP
    gap_ns = round(GAP_PERIODS * 1e9 / info.nominal_rate_hz)
    columns: dict[str, Any] = {
        "has_ambient": "ambient" in models,
        "has_denoise": has_denoise,
        "is_at_frame_instant": has_denoise and "skew" in models,
        "has_fault_detection": True,
        "has_thermal_drift": "temperature" not in models,
        "waits_for_next": waits_for_next,
        "lag_ns": lag_ns,
        "lookahead_ns": lag_ns - 1 if waits_for_next else lag_ns,
        "gap_ns": gap_ns,
        "is_tare_lost": tare.is_lost,
        "tare_ns": tare.t_ns,
        "is_scale_assumed": calibration.has_assumed_scale(serials),
        "contact_on_share": on_share,
        "contact_off_share": 0.5 * on_share,
        "contact_min_ns": CONTACT_MIN_NS,
        "contact_pause_ns": max(CONTACT_MIN_NS, gap_ns),
        "cop_sigma_max_m": COP_SIGMA_MAX_M,
        "n_load_bearing": len(serials),
    }
    shear = None if calibration.mounted is None else calibration.mounted.shear
    if shear is not None:
        columns |= {"is_shear_known": 1, "shear": shear.value, "shear_sigma": shear.sigma}
    if (servo := info.servo) is not None:
        travel = servo.ankle_travel_m_per_rad
        columns |= {
            "has_servo": 1,
            "counts_per_turn": servo.counts_per_turn,
            "zero_counts": servo.zero_counts,
            "rad_per_count": compute_segment_rad_per_count(servo),
            "travel_m_per_rad": np.nan if travel is None else travel,
        }
    return FootParams.array(1, **columns)


def _make_bearing_params(
    info: ArrayInfo,
    calibration: Calibration,
    tare: Tare,
    bearing: npt.NDArray[np.intp],
    model_inputs: LoadBearingTiles,
    by_model: dict[str, RecordArray[Any]],
) -> RecordArray[TileParams]:
    """Make the parameters of the load-bearing tiles, but for those of all tiles."""
    entries, curves = model_inputs.calibrations, by_model["static"]
    chip_max_kpa = np.array(
        [
            _compute_chip_max_kpa(*each)
            for each in zip(
                entries,
                model_inputs.rated_max_kpa.tolist(),
                model_inputs.baseline_kpa.tolist(),
                strict=True,
            )
        ]
    )
    positions_m = np.array([(t.x_m, t.y_m, t.z_m) for t in info.tiles])[bearing]
    grid = compute_grid_indices_from_1(positions_m[:, :2])
    axis_rad = fit_tile_axis_angles_rad(positions_m)
    gains = [calibration.find_mount_gain(info.tiles[i].serial) for i in bearing]
    delays = [entry.effects.late_s for entry in entries]
    return TileParams.array(
        len(bearing),
        **by_model,
        is_load_bearing=1,
        baseline_variance=tare.baseline_sigma_kpa[bearing] ** 2,
        sample_delay_ns=[0 if late is None else round(1e9 * late.value) for late in delays],
        sample_delay_sigma_s=[0.0 if late is None else late.sigma for late in delays],
        sample_delay_common_sigma_s=[entry.effects.late_common_s for entry in entries],
        chip_max_kpa=chip_max_kpa,
        range_low_kpa=curves["range_low_kpa"]
        - SIGNIFICANCE_SIGMAS * _compute_unloaded_sigma_kpa(tare)[bearing],
        unloaded_max_kpa=UNLOADED_MAX_SIGMAS * _compute_unloaded_sigma_kpa(tare)[bearing],
        saturation=make_saturation_params(
            curves,
            by_model["gas"]["gamma"] if "gas" in by_model else np.ones(len(bearing)),
            model_inputs.baseline_kpa,
            chip_max_kpa,
        ),
        dome_misfit=rubber.collect_misfits(model_inputs),
        position_m=positions_m,
        mount_gain=[1.0 if gain is None else gain.value for gain in gains],
        mount_gain_sigma=[0.0 if gain is None else gain.sigma for gain in gains],
        axis_rad=axis_rad,
        tilt_loss=compute_tilt_loss(axis_rad),
        variance_inflation=_compute_variance_inflation(tare, bearing, info.nominal_rate_hz),
        grid_index=0.0 if grid is None else np.column_stack(grid),
    )


def _compute_unloaded_sigma_kpa(tare: Tare) -> Floats:
    """Compute the standard deviation of a single unloaded reading about the true baseline."""
    return np.maximum(np.hypot(tare.noise_kpa, tare.baseline_sigma_kpa), UNLOADED_SIGMA_MIN_KPA)


def _compute_variance_inflation(
    tare: Tare, bearing: npt.NDArray[np.intp], rate_hz: float
) -> Floats:
    readings = np.arange(denoise.WINDOW_READINGS_MAX + 1)
    if tare.noise_lasting is None or tare.noise_lasting_s is None:
        return np.ones((len(bearing), len(readings)))
    part, lasts_s = tare.noise_lasting[bearing, None], tare.noise_lasting_s[bearing, None]
    return compute_variance_inflation(part, lasts_s * rate_hz, np.maximum(readings, 1))


def _compute_chip_max_kpa(
    entry: TileCalibration, rated_max_kpa: float, baseline_kpa: float
) -> float:
    facts = entry.rig
    if facts is None:
        return max(rated_max_kpa, baseline_kpa + entry.range_kpa[1])
    if facts.ended_by == "chip":
        return facts.end_absolute_kpa
    return max(rated_max_kpa, facts.end_absolute_kpa)


def compute_settling_time_s(plan: EstimationPlan) -> float:
    """Return the time in seconds until the models have settled."""
    bearing = plan.load_bearing_params
    longest_s = max(MODELS[name].longest_time_constant_s(bearing[name]) for name in plan.models)
    return max(SETTLING_MIN_S, SETTLING_TIME_CONSTANTS * longest_s)

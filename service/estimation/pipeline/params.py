"""Parameters of an estimate as records for compiled code, made from its plan."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import numpy as np

from devices.arrays import Floats, Ints
from service.estimation.fault_detection.stuck import SHARE_STEPS, StuckParams
from service.estimation.foot.geometry import compute_segment_rad_per_count
from service.estimation.models.ambient import AmbientModel, AmbientParams
from service.estimation.models.denoise import WINDOW_READINGS_MAX
from service.estimation.models.flow import FlowModel, FlowParams
from service.estimation.models.gas import GasModel, GasParams
from service.estimation.models.hysteresis import HysteresisModel, HysteresisParams
from service.estimation.models.rubber import CreepModel, RubberParams
from service.estimation.models.static import StaticParams
from service.estimation.models.temperature import TemperatureModel, TemperatureParams
from service.estimation.pipeline.plan import SIGNIFICANCE_SIGMAS, EstimationPlan
from service.estimation.pipeline.saturation import SaturationParams
from service.estimation.records import KernelRecord, RecordArray


class FootParams(KernelRecord):
    """Parameters of the foot, as in `EstimationPlan`; `has_` and `is_` are 0 or 1."""

    # Models.
    has_unwrap: int
    has_temperature: int
    has_ambient: int
    has_gas: int
    has_skew: int
    has_denoise: int
    has_hysteresis: int
    has_flow: int
    has_rubber: int
    has_fault_detection: int
    has_thermal_drift: int  # warmth that no model corrects
    # Look-ahead.
    waits_for_next: int
    lag_ns: int
    lookahead_ns: int
    gap_ns: int
    # Tare and scale.
    is_tare_lost: int
    tare_ns: int
    is_scale_assumed: int
    # Contact and centre of pressure.
    contact_on_n: float
    contact_off_n: float
    contact_min_ns: int
    contact_pause_ns: int
    cop_sigma_max_m: float
    has_grid: int
    # Servo, and its transform to angle and position.
    has_servo: int
    counts_per_turn: int
    zero_counts: float
    rad_per_count: float
    travel_m_per_rad: float
    n_load_bearing: int  # number of tiles that bear load
    contact_bound_n: float  # lower bound of the GRF that proves contact: `contact_on_n` as mounted
    # Direction of the ground's force on tiles that are not upright.
    is_shear_known: int
    shear: float
    shear_sigma: float
    # As in `stuck.StuckLimits`.
    run_max_by_equal: Annotated[Ints, (SHARE_STEPS + 1,)]
    run_max_by_double_step: Annotated[Ints, (SHARE_STEPS + 1,)]
    variance_inflation: Annotated[Floats, (WINDOW_READINGS_MAX + 1,)]  # of the sum of tiles


class TileParams(KernelRecord):
    """Parameters of a tile; those of models that are not named are zero and not read."""

    is_load_bearing: int
    a0: float  # coefficients of the chip
    b1: float
    b2: float
    c12: float
    baseline_kpa: float
    noise_kpa: float
    tare_counts: float
    stuck_check_max_kpa: float
    unloaded_band_kpa: float
    stuck: StuckParams
    # The rest is of tiles that bear load.
    asymmetry: float
    thermal_kpa_per_count: float
    baseline_variance: float
    sample_delay_ns: int
    sample_delay_sigma_s: float
    sample_delay_common_sigma_s: float
    chip_max_kpa: float
    range_low_kpa: float
    saturation: SaturationParams
    is_gas_known: int
    gas_misfit: float
    rubber_misfit: float
    position_m: Annotated[Floats, (3,)]
    mount_gain: float
    mount_gain_sigma: float
    axis_rad: float
    tilt_loss: float
    variance_inflation: Annotated[Floats, (WINDOW_READINGS_MAX + 1,)]
    grid_index: Annotated[Floats, (2,)]
    static: StaticParams
    temperature: TemperatureParams
    ambient: AmbientParams
    gas: GasParams
    flow: FlowParams
    hysteresis: HysteresisParams
    rubber: RubberParams


class KernelParams(NamedTuple):
    """Parameters of one estimate.

    Attributes:
        foot: (1,), of the foot.
        tiles: (tiles,), of the tiles.
        hull: (k, 3), unit normals and offsets in m of the half-planes that contain the tiles.
    """

    foot: RecordArray[FootParams]
    tiles: RecordArray[TileParams]
    hull: Floats


def make_kernel_params(plan: EstimationPlan) -> KernelParams:
    """Make the kernel's parameters from `plan`."""
    normals, offsets_m = plan.hull
    return KernelParams(
        foot=_make_foot_params(plan),
        tiles=_make_tile_params(plan),
        hull=np.ascontiguousarray(np.column_stack([normals, offsets_m])),
    )


def _make_foot_params(plan: EstimationPlan) -> RecordArray[FootParams]:
    model_set, servo = plan.model_set, plan.info.servo
    columns: dict[str, Any] = {
        "has_unwrap": model_set.has_unwrap,
        "has_temperature": model_set.temperature is not None,
        "has_ambient": model_set.ambient is not None,
        "has_gas": model_set.gas is not None,
        "has_hysteresis": model_set.hysteresis is not None,
        "has_flow": model_set.flow is not None,
        "has_rubber": model_set.rubber is not None,
        "has_skew": model_set.has_skew,
        "has_denoise": model_set.has_denoise,
        "has_fault_detection": plan.fault_limits is not None,
        "has_thermal_drift": plan.fault_limits is not None
        and plan.fault_limits.thermal_kpa_per_count is not None,
        "waits_for_next": plan.waits_for_next,
        # Without look-ahead the next frame is not there, and may be of the same instant.
        "lag_ns": plan.lag_ns,
        "lookahead_ns": plan.lookahead_ns,
        "gap_ns": plan.gap_ns,
        "is_tare_lost": plan.tare.is_lost,
        "tare_ns": plan.tare.t_ns,
        "is_scale_assumed": plan.is_scale_assumed,
        "contact_on_n": plan.contact.on_n,
        "contact_off_n": plan.contact.off_n,
        "contact_bound_n": plan.contact.on_n * plan.mount_gain.max(),
        "contact_min_ns": plan.contact.min_ns,
        # Time without frames does not prove that contact has changed.
        "contact_pause_ns": max(plan.contact.min_ns, plan.gap_ns),
        "cop_sigma_max_m": plan.cop_sigma_max_m,
        "has_grid": plan.grid is not None,
        "n_load_bearing": len(plan.load_bearing_columns),
        "variance_inflation": plan.variance_inflation.mean(axis=0),
    }
    if plan.fault_limits is not None:
        limits = plan.fault_limits.stuck
        columns["run_max_by_equal"] = limits.run_max_by_equal
        columns["run_max_by_double_step"] = limits.run_max_by_double_step
    if plan.shear is not None:
        columns |= {"is_shear_known": 1, "shear": plan.shear.value, "shear_sigma": plan.shear.sigma}
    if servo is not None:
        travel = servo.ankle_travel_m_per_rad
        columns |= {
            "has_servo": 1,
            "counts_per_turn": servo.counts_per_turn,
            "zero_counts": servo.zero_counts,
            "rad_per_count": compute_segment_rad_per_count(servo),
            "travel_m_per_rad": np.nan if travel is None else travel,
        }
    return FootParams.array(1, **columns)


def _make_tile_params(plan: EstimationPlan) -> RecordArray[TileParams]:
    tare, model_set, watch = plan.tare, plan.model_set, plan.fault_limits
    tiles = TileParams.array(
        len(plan.info.tiles),
        **vars(plan.compensation),
        baseline_kpa=tare.baseline_kpa,
        noise_kpa=tare.noise_kpa,
        tare_counts=tare.temperature_raw_counts,
    )
    if watch is not None:
        tiles["stuck_check_max_kpa"], tiles["unloaded_band_kpa"] = (
            watch.stuck_check_max_kpa,
            watch.unloaded_band_kpa,
        )
        tiles["stuck"] = watch.stuck.to_records()
    kpa_per_count = (
        0.0 if watch is None or watch.thermal_kpa_per_count is None else watch.thermal_kpa_per_count
    )
    load_bearing: dict[str, Any] = {
        "is_load_bearing": 1,
        "asymmetry": 0.0 if watch is None else watch.asymmetry,
        "thermal_kpa_per_count": kpa_per_count,
        "baseline_variance": plan.baseline_sigma_kpa**2,
        "sample_delay_ns": plan.sample_delay_ns,
        "sample_delay_sigma_s": plan.sample_delay_sigma_s,
        "sample_delay_common_sigma_s": plan.sample_delay_common_sigma_s,
        "chip_max_kpa": plan.chip_max_kpa,
        "range_low_kpa": model_set.static_curves.range_low_kpa
        - SIGNIFICANCE_SIGMAS * plan.unloaded_sigma_kpa,
        "saturation": plan.saturation.to_records(),
        "is_gas_known": model_set.is_gas_known,
        "gas_misfit": model_set.gas_misfit,
        "rubber_misfit": model_set.rubber_misfit,
        "position_m": plan.tile_positions_m,
        "mount_gain": plan.mount_gain,
        "mount_gain_sigma": plan.mount_gain_sigma,
        "axis_rad": plan.axis_rad,
        "tilt_loss": plan.tilt_loss,
        "variance_inflation": plan.variance_inflation,
        "static": model_set.static_curves.to_records(),
    }
    models: dict[
        str,
        TemperatureModel
        | AmbientModel
        | GasModel
        | FlowModel
        | HysteresisModel
        | CreepModel
        | None,
    ] = {
        "temperature": model_set.temperature,
        "ambient": model_set.ambient,
        "gas": model_set.gas,
        "flow": model_set.flow,
        "hysteresis": model_set.hysteresis,
        "rubber": model_set.rubber,
    }
    load_bearing |= {
        name: model.to_records() for name, model in models.items() if model is not None
    }
    if plan.grid is not None:
        load_bearing["grid_index"] = np.column_stack(plan.grid)
    for name, values in load_bearing.items():
        tiles[name][plan.load_bearing_columns] = values
    return tiles

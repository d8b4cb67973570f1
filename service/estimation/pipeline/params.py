"""Parameters of an estimate as records for compiled code: of the models, the foot and the tiles.

`ModelParamsByName` lists the models in the order of their use. Those up to `skew` belong to the
sample stage, reading by reading; the others to the smoothing stage, within the look-ahead. Fields
`has_` and `is_` are 0 or 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

from devices.arrays import Floats
from devices.errors import CalibrationError, UsageError
from service.estimation.fault_detection.fault_limits import FaultParams
from service.estimation.fault_detection.stuck import EqualCountLimits
from service.estimation.models import LoadBearingTiles, ModelParams
from service.estimation.models.ambient import AmbientParams
from service.estimation.models.denoise import WINDOW_READINGS_MAX
from service.estimation.models.gas import GasParams
from service.estimation.models.hysteresis import HysteresisParams
from service.estimation.models.rubber import RubberParams
from service.estimation.models.static import StaticParams
from service.estimation.models.temperature import TemperatureParams
from service.estimation.pipeline.saturation import SaturationParams
from service.estimation.records import KernelRecord, RecordArray


class ModelParamsByName(KernelRecord):
    """Parameters of a tile's models; one without further parameters has `ModelParams`."""

    unwrap: ModelParams
    temperature: TemperatureParams
    ambient: AmbientParams
    gas: GasParams
    static: StaticParams
    skew: ModelParams
    denoise: ModelParams
    hysteresis: HysteresisParams
    rubber: RubberParams


MODELS: Mapping[str, type[ModelParams]] = ModelParamsByName.fields()
"""All models by name, in the order of their use."""
MODEL_NAMES = tuple(MODELS)


def check_known_models_with_static(models: Sequence[str]) -> None:
    """Reject unknown models, and a selection without `static`.

    Raises:
        UsageError: an unknown model, or no `static`.
    """
    for name in models:
        if name not in MODELS:
            raise UsageError(
                f"unknown model {name!r}", expected=f"some of {', '.join(MODEL_NAMES)}"
            )
    if "static" not in models:
        raise UsageError("without the model 'static' there is no force", remedy="Add it")


def make_model_params(tiles: LoadBearingTiles) -> dict[str, RecordArray[Any]]:
    """Make the parameters of the models in use, by name in the order of their use, (tiles,).

    Raises:
        UsageError: an unknown model, no `static`, or `ambient` without a bare tile.
        CalibrationError: the tiles are not calibrated for one of the models.
    """
    check_known_models_with_static(tiles.models)
    used = {name: model for name, model in MODELS.items() if name in tiles.models}
    for name, model in used.items():
        _reject_undetermined(name, model, tiles)
    return {name: model.make(tiles) for name, model in used.items()}


def _reject_undetermined(name: str, model: type[ModelParams], tiles: LoadBearingTiles) -> None:
    if model.effect is None:
        return
    # ANY: fields of Effects
    lacks = [getattr(tile.effects, model.effect) is None for tile in tiles.calibrations]
    for tile, is_lacking in zip(tiles.calibrations, lacks, strict=True):
        if is_lacking and (model.is_needed_of_every_tile or all(lacks)):
            reasons: dict[Any, str] = {**tile.effects.refused}
            reason = reasons.get(name, "its calibration does not contain it")
            raise CalibrationError(
                f"model {name!r} is not offered for tile {tile.serial}: {reason}",
                where=tiles.calibration_label,
                remedy="Leave the model out, or calibrate the tile from a recording with holds, "
                "releases, taps and a soak at two temperatures",
            )


class FootParams(KernelRecord):
    """Parameters of the foot."""

    # Models that work on all tiles at once.
    has_ambient: int
    has_denoise: int
    is_at_frame_instant: int  # averages are of the frame's instant instead of each tile's
    has_fault_detection: int
    has_thermal_drift: int  # warmth that no model corrects
    # Look-ahead.
    waits_for_next: int  # every frame waits for the next one, for outlier replacement
    lag_ns: int
    lookahead_ns: int
    gap_ns: int  # time between two frames from which on there is a gap between them
    # Tare and scale.
    is_tare_lost: int
    tare_ns: int
    is_scale_assumed: int
    # Contact: forces at which it begins and ends, and the time for which a change has to last.
    contact_on_n: float
    contact_off_n: float
    contact_on_share: float  # of the greatest recent force, if that is more
    contact_off_share: float
    contact_min_ns: int
    contact_pause_ns: int  # time without frames does not prove that contact has changed
    contact_bound_n: float  # lower bound of the GRF that proves contact: `contact_on_n` as mounted
    cop_sigma_max_m: float
    has_grid: int
    # Servo, and its transform to angle and position.
    has_servo: int
    counts_per_turn: int
    zero_counts: float
    rad_per_count: float
    travel_m_per_rad: float
    n_load_bearing: int  # number of tiles that bear load
    # Direction of the ground's force on tiles that are not upright.
    is_shear_known: int
    shear: float
    shear_sigma: float
    equal_count_limits: EqualCountLimits
    variance_inflation: Annotated[Floats, (WINDOW_READINGS_MAX + 1,)]  # of the sum of tiles


class TileParams(ModelParamsByName):
    """Parameters of a tile and of its models; those of models that are not used are not read."""

    is_load_bearing: int
    a0: float  # law of the chip's counts
    b1: float
    b2: float
    c12: float
    unit_kpa: float
    offset_kpa: float
    rated_min_kpa: float
    rated_max_kpa: float
    wrap_counts: float
    temperature_change_max_counts: float
    baseline_kpa: float
    noise_kpa: float
    tare_counts: float
    faults: FaultParams
    # The rest is of tiles that bear load.
    baseline_variance: float
    sample_delay_ns: int  # of the tile's samples behind the instants in its frames
    sample_delay_sigma_s: float  # standard uncertainty of that, independent between tiles
    sample_delay_common_sigma_s: float  # and shared by all tiles
    # Absolute pressure above which a chip saturates: the end of its rated range, or the highest
    # pressure in the rig, if that was higher or the chip saturated there.
    chip_max_kpa: float
    range_low_kpa: float  # gauge pressure below which noise does not explain the distance
    unloaded_max_kpa: float  # gauge pressure up to which noise explains it without a load
    saturation: SaturationParams
    dome_misfit: float  # uncertain part of the corrections of creep and loop
    position_m: Annotated[Floats, (3,)]
    mount_gain: float  # newtons of the ground on its part of the foot for a newton of the dome
    mount_gain_sigma: float
    axis_rad: float  # angle of the tile's axis to the segment
    tilt_loss: float  # part of its force that is not along the segment, by that angle
    variance_inflation: Annotated[Floats, (WINDOW_READINGS_MAX + 1,)]  # see `denoise_sample`
    grid_index: Annotated[Floats, (2,)]


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

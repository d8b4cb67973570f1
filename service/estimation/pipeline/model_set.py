"""Model set: the models that a scene names, with their parameters over the load-bearing tiles.

Sample stage, reading by reading: baseline (temperature, ambient), gas, static curve, skew.
Smoothing stage, within the look-ahead: denoise, hysteresis, rubber.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats
from devices.chips.mpl115a2 import TADC_PER_KELVIN
from devices.errors import CalibrationError, UsageError
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.effects import (
    MISFIT_MIN,
    EffectName,
    GasEffect,
    RubberEffect,
    parameter_values,
)
from service.estimation.models.ambient import AmbientModel
from service.estimation.models.flow import FlowModel
from service.estimation.models.gas import GasModel
from service.estimation.models.hysteresis import WIDTHS_N, HysteresisModel
from service.estimation.models.rubber import CreepModel
from service.estimation.models.static import StaticCurves
from service.estimation.models.temperature import TemperatureModel
from service.estimation.tare.tare import Tare

MODEL_NAMES = (
    "unwrap",
    "temperature",
    "ambient",
    "gas",
    "static",
    "skew",
    "denoise",
    "hysteresis",
    "rubber",
)
"""Names of all models, in the order of their use."""


@dataclass(frozen=True)
class ModelSet:
    """Parameters of the models, arrays over load-bearing tiles; None for a model not named.

    Attributes:
        has_unwrap: whether wrapped counts are corrected.
        temperature: shift of the baseline.
        ambient: transmission of the surrounding pressure.
        gas: heat of the bubbles.
        is_gas_known: (tiles,), whether the calibration has a tile's gas. Other tiles use the gas of
            a median tile, for their uncertainty.
        gas_misfit: (tiles,), uncertain part of the gas correction.
        static_curves: static curves; of settled forces if `rubber` is named.
        has_skew: whether tiles are interpolated to the frame's instant.
        has_denoise: whether noise is averaged and outliers are replaced.
        hysteresis: loop of the rubber.
        flow: viscous branch of the rubber; None if no tile's calibration has one.
        rubber: creep.
        rubber_misfit: (tiles,), uncertain part of the corrections of creep and loop.
    """

    has_unwrap: bool
    temperature: TemperatureModel | None
    ambient: AmbientModel | None
    gas: GasModel | None
    is_gas_known: Bools
    gas_misfit: Floats
    static_curves: StaticCurves
    has_skew: bool
    has_denoise: bool
    hysteresis: HysteresisModel | None
    flow: FlowModel | None
    rubber: CreepModel | None
    rubber_misfit: Floats


def make_checked_model_set(
    info: ArrayInfo, calibration: Calibration, tare: Tare, models: Sequence[str]
) -> ModelSet:
    """Compute the parameters of the models named.

    Raises:
        UsageError: an unknown model, no `static`, or `ambient` without a bare tile.
        CalibrationError: a bearing tile is not calibrated, or not for one of the models.
    """
    check_known_models_with_static(models)
    bearing = [tile for tile in info.tiles if not tile.reference]
    tiles = calibration.get_tiles_or_wildcard([tile.serial for tile in bearing])
    columns = np.array([i for i, tile in enumerate(info.tiles) if not tile.reference])
    for name in ("temperature", "ambient", "gas", "rubber", "hysteresis"):
        if name in models:
            _reject_undetermined(name, tiles, calibration, every=name in _REQUIRED_OF_ALL_TILES)
    if "ambient" in models and len(bearing) == len(info.tiles):
        raise UsageError(
            "model 'ambient' needs a bare reference tile, and the array has none",
            remedy="Leave it out, or plug in a bare chip and mark it `reference = true`",
        )
    _reject_mixed_plays(tiles, models, calibration)
    baseline_kpa = tare.baseline_kpa[columns]
    return ModelSet(
        has_unwrap="unwrap" in models,
        temperature=(
            _make_temperature(tiles, tare, columns, info) if "temperature" in models else None
        ),
        ambient=_make_ambient(tiles, baseline_kpa) if "ambient" in models else None,
        gas=_make_gas(tiles, baseline_kpa) if "gas" in models else None,
        is_gas_known=np.array([tile.effects.gas is not None for tile in tiles]),
        gas_misfit=_collect_misfits([tile.effects.gas for tile in tiles], unknown=1.0),
        static_curves=StaticCurves(tiles, use_settled_curve="rubber" in models),
        has_skew="skew" in models,
        has_denoise="denoise" in models,
        hysteresis=_make_hysteresis(tiles) if "hysteresis" in models else None,
        flow=_make_flow(tiles) if "hysteresis" in models else None,
        rubber=_make_rubber(tiles) if "rubber" in models else None,
        rubber_misfit=_collect_misfits([tile.effects.rubber for tile in tiles], unknown=0.0),
    )


def check_known_models_with_static(models: Sequence[str]) -> None:
    """Reject unknown models, and a selection without `static`.

    Raises:
        UsageError: an unknown model, or no `static`.
    """
    for name in models:
        if name not in MODEL_NAMES:
            raise UsageError(
                f"unknown model {name!r}", expected=f"some of {', '.join(MODEL_NAMES)}"
            )
    if "static" not in models:
        raise UsageError("without the model 'static' there is no force", remedy="Add it")


_REQUIRED_OF_ALL_TILES = frozenset({"temperature", "ambient"})
"""Models that every tile needs: their corrections are as large as any load. A single tile may lack
another model; its uncertainty then contains the missing correction."""


def _reject_undetermined(
    name: EffectName, tiles: Sequence[TileCalibration], calibration: Calibration, *, every: bool
) -> None:
    needed = "temperature" if name == "ambient" else name
    lacks = [getattr(tile.effects, needed) is None for tile in tiles]  # ANY: fields of Effects
    for tile, is_lacking in zip(tiles, lacks, strict=True):
        if is_lacking and (every or all(lacks)):
            reason = tile.effects.refused.get(name, "its calibration does not contain it")
            raise CalibrationError(
                f"model {name!r} is not offered for tile {tile.serial}: {reason}",
                where=f"calibration {calibration.name} ({calibration.id})",
                remedy="Leave the model out, or calibrate the tile from a recording with holds, "
                "releases, taps and a soak at two temperatures",
            )


def _reject_mixed_plays(
    tiles: Sequence[TileCalibration], models: Sequence[str], calibration: Calibration
) -> None:
    """Reject tiles with another number of plays than the model's."""
    plays = {len(e.part) for tile in tiles if (e := tile.effects.hysteresis) is not None}
    if "hysteresis" in models and plays != {len(WIDTHS_N)}:
        raise CalibrationError(
            f"its tiles have {sorted(plays)} plays",
            where=f"calibration {calibration.name} ({calibration.id})",
            expected=f"{len(WIDTHS_N)} plays",
            remedy="Calibrate all of them with this version",
        )


def _make_temperature(
    tiles: Sequence[TileCalibration], tare: Tare, columns: npt.NDArray[np.intp], info: ArrayInfo
) -> TemperatureModel:
    found = [effect for tile in tiles if (effect := tile.effects.temperature) is not None]
    return TemperatureModel(
        kpa_per_count=parameter_values(e.kpa_per_k for e in found) / TADC_PER_KELVIN,
        relative_sigma=np.array([e.kpa_per_k.sigma / e.kpa_per_k.value for e in found]),
        lag_s=parameter_values(e.lag_s for e in found),
        lag_sigma_s=np.array([e.lag_s.sigma for e in found]),
        tare_counts=tare.temperature_raw_counts[columns],
        baseline_kpa=tare.baseline_kpa[columns],
        step_s=1.0 / info.nominal_rate_hz,
    )


def _make_gas(tiles: Sequence[TileCalibration], baseline_kpa: Floats) -> GasModel:
    found = [tile.effects.gas for tile in tiles]
    known = [effect for effect in found if effect is not None]
    gamma, tau_s = (
        float(np.median(parameter_values(each)))
        for each in ([e.gamma for e in known], [e.tau_s for e in known])
    )
    return GasModel(
        gamma=np.array([gamma if effect is None else effect.gamma.value for effect in found]),
        tau_s=np.array([tau_s if effect is None else effect.tau_s.value for effect in found]),
        wall_per_kpa=np.array([tile.effects.wall_compliance_or_default_per_kpa for tile in tiles]),
        baseline_kpa=baseline_kpa,
    )


def _make_hysteresis(tiles: Sequence[TileCalibration]) -> HysteresisModel:
    found = [tile.effects.hysteresis for tile in tiles]
    none = np.zeros(len(WIDTHS_N))
    weights = [none if e is None else parameter_values(e.part) for e in found]
    return HysteresisModel(play_weights=np.array(weights))


def _make_flow(tiles: Sequence[TileCalibration]) -> FlowModel | None:
    found = [None if (e := tile.effects.hysteresis) is None else e.flow for tile in tiles]
    if all(effect is None for effect in found):
        return None
    # A tile without the branch has the fraction 0.
    return FlowModel(
        fraction=np.array([0.0 if e is None else e.part.value for e in found]),
        stress_scale_n=np.array([1.0 if e is None else e.stress_n.value for e in found]),
        exponent=np.array([4.0 if e is None else e.power.value for e in found]),
    )


def _make_rubber(tiles: Sequence[TileCalibration]) -> CreepModel:
    """Make parameters with the largest number of terms of a tile; missing terms are zero."""
    found = [tile.effects.rubber for tile in tiles]
    terms = max(len(effect.part) for effect in found if effect is not None)
    fraction, tau_s = np.zeros((len(tiles), terms)), np.ones((len(tiles), terms))
    for i, effect in enumerate(found):
        if effect is not None:
            fraction[i, : len(effect.part)] = parameter_values(effect.part)
            tau_s[i, : len(effect.part)] = parameter_values(effect.tau_s)
    return CreepModel(creep_fraction=fraction, tau_s=tau_s)


def _collect_misfits(
    effects: Sequence[GasEffect | RubberEffect | None], *, unknown: float
) -> Floats:
    return np.array([unknown if e is None else max(e.misfit, MISFIT_MIN) for e in effects])


def _make_ambient(tiles: Sequence[TileCalibration], baseline_kpa: Floats) -> AmbientModel:
    give = (
        np.array([tile.effects.wall_compliance_or_default_per_kpa for tile in tiles]) * baseline_kpa
    )
    found = [effect for tile in tiles if (effect := tile.effects.temperature) is not None]
    wall = [e.wall_per_kpa for e in found]
    relative = max((w.sigma / w.value if w.value > 0.0 else 1.0 for w in wall), default=1.0)
    return AmbientModel(transmitted_fraction=give / (1.0 + give), relative_sigma=relative)

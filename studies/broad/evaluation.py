"""Evaluation of one recording for the result file: estimates, and the tiles' true properties."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.chips.mpl115a2 import PRESSURE_MAX_KPA
from devices.emulation.part_families import draw_family_chip
from devices.emulation.parts import DomeProperties
from devices.emulation.world import DomeEffect, World
from devices.flags import EstimateFlag
from service.estimation.calibration import TileCalibration
from service.estimation.effects import Effects, Parameter
from service.estimation.estimates import SIGMAS_95
from service.offline.accuracy import ACCURACY_COLUMNS, PHASES, classify_phases, compute_accuracy
from studies.benchmark.draws import DrawRecording
from studies.broad.results import CaseResult, PhaseCounts, TileResult

EVALUATED_COLUMNS = (*ACCURACY_COLUMNS, "force_n", "force_sigma_n", "true_force_n")
FAULTY_TILE_FLAGS = (EstimateFlag.STUCK, EstimateFlag.CLIPPED, EstimateFlag.BASELINE_LOST)
"""Flags of tiles that answer but are faulty."""
UNSATURATED_MARGIN_SIGMAS = 4.0
"""Distance of the settled pressure below the calibrated end, in standard deviations of a reading,
from which a saturation flag is wrong."""
FORCE_EFFECTS: tuple[DomeEffect, ...] = ("gas", "rubber", "hysteresis")
MIN_LOAD_N = 0.5
EFFECT_PERCENTILE = 95


def evaluate_estimates(
    columns: Mapping[str, npt.NDArray[Any]],
    find_unsaturated: Callable[[], npt.NDArray[np.bool_]],
    lag_ms: float,
) -> CaseResult:
    """Compute errors, coverage and flag counts.

    Args:
        columns: `EVALUATED_COLUMNS` of every frame of the recording.
        find_unsaturated: returns `surely_below_end`, (n, tiles); called only if needed,
            because it takes as long as the recording.
        lag_ms: look-ahead of the estimates.
    """
    accuracy = compute_accuracy({name: columns[name] for name in ACCURACY_COLUMNS}, lag_ms=lag_ms)
    status = columns["estimate_flags"]
    error_n = columns["grf_n"] - columns["true_grf_n"]
    sigma_n = columns["grf_sigma_n"]
    usable = ((status & EstimateFlag.SATURATED) == 0) & np.isfinite(error_n)
    phases = classify_phases(columns["t_ns"], columns["true_grf_n"])
    covered = np.abs(error_n) <= SIGMAS_95 * sigma_n
    # A lower bound has no sigma.
    bounds = np.isfinite(columns["force_n"]) & ~np.isfinite(columns["force_sigma_n"])
    held = columns["true_force_n"] >= columns["force_n"]
    return CaseResult(
        frames=accuracy.frames,
        grf_mae_n=nan_to_none(accuracy.grf_mae_n),
        peak_error_n=nan_to_none(accuracy.peak_error_n),
        cop_p95_m=nan_to_none(accuracy.cop_p95_m),
        flight_mean_n=nan_to_none(accuracy.flight_mean_n),
        phases={
            name: PhaseCounts(
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
        wrongly=int((bounds & find_unsaturated()).sum()) if bounds.any() else 0,
        held=int((bounds & held).sum()),
        grf_bounds=accuracy.bounds.frames,
        grf_bounds_held=accuracy.bounds.within,
        after_frames=accuracy.after_saturation.frames,
        after_within=accuracy.after_saturation.within,
        after_saturation_mae_n=nan_to_none(accuracy.after_saturation_mae_n),
        seconds=float(columns["t_ns"][-1] - columns["t_ns"][0]) * 1e-9,
        alarms=_count_alarms(status),
    )


def _count_alarms(status: npt.NDArray[np.uint16]) -> int:
    """Count the onsets of `FAULTY_TILE_FLAGS`."""
    return sum(
        int((np.diff((status & bit) != 0, prepend=False) & ((status & bit) != 0)).sum())
        for bit in FAULTY_TILE_FLAGS
    )


def find_unsaturated_tiles(recording: DrawRecording, world: World) -> npt.NDArray[np.bool_]:
    """Return which tiles are surely within calibration and chip range, (n, tiles)."""
    t_ns = recording.frames.t_mono_ns
    doubt_kpa = UNSATURATED_MARGIN_SIGMAS * world.scene.emulation.noise_kpa
    unloaded_kpa = np.array([part.seal_kpa for part in world.dome_parts])
    settled_kpa = world.compute_dome_kpa(t_ns, ("gas", "surroundings")) - unloaded_kpa
    return np.asarray(
        (settled_kpa < _get_range_ends_kpa(recording) - doubt_kpa)
        & (world.compute_dome_kpa(t_ns) < PRESSURE_MAX_KPA - doubt_kpa)
    )


def _get_range_ends_kpa(recording: DrawRecording) -> Floats:
    """Return each tile's calibrated gauge pressure range end; infinite for a bare tile."""
    return np.array(
        [
            math.inf if tile.reference else recording.calibration.get_tile(tile.serial).range_kpa[1]
            for tile in recording.info.tiles
        ]
    )


def nan_to_none(value: float) -> float | None:
    """Return the number, or None for NaN."""
    return value if math.isfinite(value) else None


def describe_tiles(recording: DrawRecording, world: World, seed: int) -> tuple[TileResult, ...]:
    """Describe every tile of an array, from a recording at constant temperature."""
    t_ns = recording.frames.t_mono_ns
    whole_kpa = world.compute_dome_kpa(t_ns)
    less_kpa = {name: world.compute_dome_kpa(t_ns, (name,)) for name in FORCE_EFFECTS}
    loaded = recording.truth["true_force_n"] > MIN_LOAD_N
    tiles = []
    for i, serial in enumerate(recording.info.serials):
        part = world.dome_parts[i]
        felt_n = part.compute_static_force_n(whole_kpa[loaded[:, i], i])
        effect_n: dict[str, float] = {
            name: _compute_effect_size_n(felt_n - part.compute_static_force_n(kpa[loaded[:, i], i]))
            for name, kpa in less_kpa.items()
        }
        entry = recording.calibration.get_tile(serial)
        late_ns = draw_family_chip("broad", serial, seed).sample_delay_ns
        tiles.append(_describe_tile(entry, part, late_ns, effect_n))
    return tuple(tiles)


def _compute_effect_size_n(difference_n: Floats) -> float:
    return (
        float(np.percentile(np.abs(difference_n), EFFECT_PERCENTILE)) if len(difference_n) else 0.0
    )


def _describe_tile(
    entry: TileCalibration, part: DomeProperties, late_ns: int, effect_n: dict[str, float]
) -> TileResult:
    effects = entry.effects
    offered = {
        "gas": effects.gas,
        "rubber": effects.rubber,
        "hysteresis": effects.hysteresis,
        "temperature": effects.temperature,
    }
    has = {
        "gas": part.kappa > 0.0,
        "rubber": bool(part.creep_s),
        "hysteresis": part.loop_n > 0.0 or part.viscous_n > 0.0,
    }
    return TileResult(
        serial=entry.serial,
        drawn={
            "gamma": 1.0 / (1.0 - part.kappa),
            "conduction_s": part.conduction_s,
            "late_s": late_ns * 1e-9,
            "gas_lag_s": part.gas_lag_s,
            "creep": sum(part.creep_parts),
            **{f"creep_s_{i}": tau_s for i, tau_s in enumerate(part.creep_s)},
            "loop_n": part.loop_n,
            "viscous_n": part.viscous_n,
        },
        effect_n=effect_n,
        lacks=tuple(name for name, is_there in has.items() if not is_there),
        given=tuple(name for name, effect in offered.items() if effect is not None),
        found=_list_fitted_parameters(effects),
        refused={str(name): reason for name, reason in effects.refused.items()},
        at_bound=effects.at_bound,
    )


def _list_fitted_parameters(effects: Effects) -> dict[str, float]:
    parameters: dict[str, Parameter | None] = {"late_s": effects.late_s}
    if effects.gas is not None:
        parameters |= {"gamma": effects.gas.gamma, "tau_s": effects.gas.tau_s}
    if effects.temperature is not None:
        parameters["gas_lag_s"] = effects.temperature.lag_s
    if effects.rubber is not None:
        parameters |= {f"creep_{i}": part for i, part in enumerate(effects.rubber.part)}
        parameters |= {f"creep_s_{i}": tau for i, tau in enumerate(effects.rubber.tau_s)}
    found: dict[str, float] = {}
    for name, parameter in parameters.items():
        if parameter is not None:
            found |= {name: parameter.value, f"{name}_sigma": parameter.sigma}
    return found

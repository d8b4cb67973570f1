"""True tile properties of the emulator beside the fitted ones, to judge each tile's models."""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats
from devices.emulation.part_families import draw_family_chip
from devices.emulation.parts import DomeProperties
from devices.emulation.world import DomeEffect, World
from service.estimation.calibration import TileCalibration
from service.estimation.effects import Effects, Parameter
from service.offline.benchmark.broad.results import TileResult
from service.offline.benchmark.draws import DrawRecording

FORCE_EFFECTS: tuple[DomeEffect, ...] = ("gas", "rubber", "hysteresis")
MIN_LOAD_N = 0.5
EFFECT_PERCENTILE = 95


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

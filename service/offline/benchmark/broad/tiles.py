"""True tile properties of the emulator beside the fitted ones, to judge each tile's models."""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats
from devices.emulation.families import chip_of
from devices.emulation.parts import DomePart
from devices.emulation.world import Effect, World
from service.estimation.calibration import TileCalibration
from service.estimation.effects import Effects, Parameter
from service.offline.benchmark.broad.results import Tile
from service.offline.benchmark.draws import Recording

RUBBERY: tuple[Effect, ...] = ("gas", "rubber", "hysteresis")
LOADED_N = 0.5
EFFECT_PERCENTILE = 95


def tiles_of(recording: Recording, world: World, seed: int) -> tuple[Tile, ...]:
    """Describe every tile of an array, from a recording at constant temperature."""
    t_ns = recording.frames.t_mono_ns
    whole_kpa = world.dome_kpa(t_ns)
    less_kpa = {name: world.dome_kpa(t_ns, (name,)) for name in RUBBERY}
    loaded = recording.truth["true_force_n"] > LOADED_N
    tiles = []
    for i, serial in enumerate(recording.info.serials):
        part = world.domes[i]
        felt_n = part.felt_n(whole_kpa[loaded[:, i], i])
        effect_n: dict[str, float] = {
            name: _size(felt_n - part.felt_n(kpa[loaded[:, i], i]))
            for name, kpa in less_kpa.items()
        }
        entry = recording.calibration.of(serial)
        late_ns = chip_of("broad", serial, seed).late_ns
        tiles.append(_tile(entry, part, late_ns, effect_n))
    return tuple(tiles)


def _size(difference_n: Floats) -> float:
    return (
        float(np.percentile(np.abs(difference_n), EFFECT_PERCENTILE)) if len(difference_n) else 0.0
    )


def _tile(entry: TileCalibration, part: DomePart, late_ns: int, effect_n: dict[str, float]) -> Tile:
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
    return Tile(
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
        found=_found(effects),
        refused={str(name): reason for name, reason in effects.refused.items()},
        at_bound=effects.at_bound,
    )


def _found(effects: Effects) -> dict[str, float]:
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

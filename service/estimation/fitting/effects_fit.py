"""Fit of a dome's effects to its recordings, and the delays of sample and reference.

A rig measures each tile against the reference, and so the sum of two delays. Differences between
tiles are the tiles' own. The mean may be the tiles' or the reference's; prior knowledge of the
reference divides it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from devices.arrays import Bools, Floats, Ints
from service.estimation.calibration import TileCalibration, is_increasing_cubic
from service.estimation.effects import (
    MISFIT_MIN,
    Effects,
    Parameter,
    RubberEffect,
    TemperatureEffect,
    parameter_values,
)
from service.estimation.fitting.dome_model import (
    SAMPLE_DELAY_SIGMA_S,
    DomeModel,
    make_clamped_pchip_force,
)
from service.estimation.fitting.effect_selection import fit_significant_effects
from service.estimation.fitting.rig.indentation import (
    Indentation,
    LoadingPoints,
    ThermalSoak,
    extract_loading_points,
    extract_soak_or_empty,
    join_loading_points,
    measure_last_second_before_first_load,
    select_loaded,
)
from service.estimation.fitting.thermal_soak import fit_temperature_effect

DEFAULT_REFERENCE_DELAY = Parameter(value=0.0, sigma=0.0005)
"""Delay of a load cell behind an amplifier of some 300 Hz."""


def separate_delays(effects: Sequence[Effects], reference_delay: Parameter) -> list[Effects]:
    """Return the effects of tiles of one rig with their own sample delays, in the same order.

    The mean over tiles is divided between tiles and reference in proportion to their variances; its
    remaining uncertainty is common to all tiles.

    Args:
        effects: of the tiles, with `late_s` as measured against the reference.
        reference_delay: of the reference.
    """
    seen = [each.late_s.value for each in effects if each.late_s is not None]
    if not seen:
        return list(effects)
    shared_s = float(np.mean(seen)) - reference_delay.value
    of_tiles = SAMPLE_DELAY_SIGMA_S**2 / (SAMPLE_DELAY_SIGMA_S**2 + reference_delay.sigma**2)
    reference_s = reference_delay.value + (1.0 - of_tiles) * shared_s
    common_s = float(np.sqrt(of_tiles)) * reference_delay.sigma
    return [
        each
        if each.late_s is None
        else each.model_copy(
            update={
                "late_s": Parameter(value=each.late_s.value - reference_s, sigma=each.late_s.sigma),
                "late_common_s": common_s,
                "reference_late_s": reference_s,
            }
        )
        for each in effects
    ]


_U_OF_X = np.array([[0.5, 0.5, 0.375], [0.0, 0.25, 0.375], [0.0, 0.0, 0.125]])
"""Transform of a cubic without constant term from x = gauge / range to u = 2 x - 1."""


def fit_determined_effects(
    recordings: Sequence[Indentation],
    tile: TileCalibration,
    reference_delay: Parameter = DEFAULT_REFERENCE_DELAY,
) -> Effects:
    """Fit the effects that the recordings determine; others are None, with the reason.

    Args:
        recordings: of the tile in the rig, all of one chip.
        tile: its static curve, from the same recordings.
        reference_delay: of the reference; `late_s` of the answer contains it (see
            `separate_delays`).
    """
    points, baseline_kpa = collect_loadings_at_common_baseline(recordings)
    noise_kpa = float(
        np.mean(
            [
                measure_last_second_before_first_load(each).noise_kpa
                for each in select_loaded(recordings)
            ]
        )
    )
    soaked = _select_best_soak(
        [
            fit_temperature_effect(extract_soak_or_empty(recording, noise_kpa))
            for recording in recordings
        ]
    )
    effects = fit_significant_effects(
        points,
        scale_kpa=tile.range_kpa[1],
        baseline_kpa=baseline_kpa,
        initial_curve=_convert_centred_cubic_to_c1_c2_c3(tile.coefficients),
        temperature_effect=soaked,
        reference_delay=reference_delay,
    )
    effects = _center_curve(effects)
    if not isinstance(soaked, TemperatureEffect):
        return effects
    # Recovery from the loads before a soak is no effect of temperature.
    model = _make_dome_model(effects, tile, baseline_kpa)
    pressed = select_loaded(recordings)
    soaks = [_subtract_recovery(each, pressed, noise_kpa, model) for each in recordings]
    again = _select_best_soak([fit_temperature_effect(each) for each in soaks])
    if not isinstance(again, TemperatureEffect):
        return effects
    return effects.model_copy(
        update={"temperature": _add_recovery_uncertainty(again, soaked, effects.rubber)}
    )


def _subtract_recovery(
    recording: Indentation, pressed: Sequence[Indentation], noise_kpa: float, model: DomeModel
) -> ThermalSoak:
    """Return a recording's soak less the dome's recovery from the loads before it."""
    soaking = extract_soak_or_empty(recording, noise_kpa)
    if not len(soaking.t_s):
        return soaking
    soak_ns = recording.t_ns[recording.phase == "soak"]
    ends_ns = [_last_loaded_ns(each) for each in pressed]
    before = [i for i, end_ns in enumerate(ends_ns) if end_ns <= soak_ns[0]]
    if not before:
        return soaking
    last = max(before, key=lambda i: ends_ns[i])
    zero = measure_last_second_before_first_load(pressed[last])
    points = extract_loading_points(pressed[last], zero.reference_zero_n, zero.noise_kpa)
    since_s = (soak_ns - ends_ns[last]) * 1e-9
    t_s = np.concatenate([points.t_s, points.t_s[-1] + since_s])
    force_n = np.concatenate([points.force_n, np.zeros(len(since_s))])
    left_kpa = model.compute_response(t_s, force_n).kpa[len(points.t_s) :] - model.baseline_kpa
    return replace(soaking, kpa=soaking.kpa - left_kpa)


def _last_loaded_ns(pressed: Indentation) -> int:
    """Return the last instant at which the tile was under the spindle."""
    return int(pressed.t_ns[pressed.is_under_indenter & (pressed.phase != "soak")][-1])


def _add_recovery_uncertainty(
    now: TemperatureEffect, before: TemperatureEffect, rubber: RubberEffect | None
) -> TemperatureEffect:
    """Add the uncertainty of the recovery that was subtracted."""
    doubt = max(MISFIT_MIN, 0.0 if rubber is None else rubber.misfit)

    def add_doubt(a: Parameter, b: Parameter) -> Parameter:
        return Parameter(value=a.value, sigma=math.hypot(a.sigma, doubt * (a.value - b.value)))

    return TemperatureEffect(
        kpa_per_k=add_doubt(now.kpa_per_k, before.kpa_per_k),
        lag_s=add_doubt(now.lag_s, before.lag_s),
        wall_per_kpa=add_doubt(now.wall_per_kpa, before.wall_per_kpa),
    )


def _make_dome_model(effects: Effects, tile: TileCalibration, baseline_kpa: float) -> DomeModel:
    """Make the forward model of a tile, without its sample delay.

    Args:
        effects: with the curve in the tile's variable.
        tile: static curve, used without creep.
        baseline_kpa: absolute pressure unloaded.
    """
    gas, rubber, loop = effects.gas, effects.rubber, effects.hysteresis
    curve = _convert_centred_cubic_to_c1_c2_c3(
        tile.coefficients if rubber is None else rubber.coefficients
    )
    model = DomeModel(
        curve, tile.range_kpa[1], baseline_kpa, effects.wall_compliance_or_default_per_kpa
    )
    if gas is not None:
        model = model._replace(gamma=gas.gamma.value, tau_s=gas.tau_s.value)
    if rubber is not None:
        model = model._replace(
            part=parameter_values(rubber.part), creep_s=parameter_values(rubber.tau_s)
        )
    if loop is not None:
        model = model._replace(loop=parameter_values(loop.part))
        if (flow := loop.flow) is not None:
            part, flow_n, power = parameter_values((flow.part, flow.stress_n, flow.power)).tolist()
            model = model._replace(flow_part=part, flow_n=flow_n, flow_power=power)
    return model


def _center_curve(effects: Effects) -> Effects:
    """Convert the curve of settled forces to the variable of the tile's static curve."""
    rubber = effects.rubber
    if rubber is None:
        return effects
    curve = _U_OF_X @ np.array(rubber.coefficients[1:])
    polynomial = (0.0, float(curve[0]), float(curve[1]), float(curve[2]))
    if not is_increasing_cubic(polynomial, (-1.0, 1.0)):
        reason = "the curve of settled forces is not monotonic"
        return effects.model_copy(
            update={"rubber": None, "refused": {**effects.refused, "rubber": reason}}
        )
    covariance = _U_OF_X @ np.array(rubber.covariance) @ _U_OF_X.T
    in_u = rubber.model_copy(
        update={
            "coefficients": polynomial,
            "covariance": tuple(map(tuple, covariance.tolist())),
        }
    )
    return effects.model_copy(update={"rubber": in_u})


class TileLoadings(NamedTuple):
    """All loadings of a tile, shifted to one common baseline."""

    points: LoadingPoints
    baseline_kpa: float


def collect_loadings_at_common_baseline(recordings: Sequence[Indentation]) -> TileLoadings:
    """Collect every loading of a tile, shifted to one common baseline."""
    recordings = select_loaded(recordings)
    zeros = [measure_last_second_before_first_load(recording) for recording in recordings]
    baseline_kpa = float(np.mean([zero.baseline_kpa for zero in zeros]))
    parts = []
    for recording, zero in zip(recordings, zeros, strict=True):
        part = extract_loading_points(recording, zero.reference_zero_n, zero.noise_kpa)
        parts.append(replace(part, kpa=part.kpa - (zero.baseline_kpa - baseline_kpa)))
    return TileLoadings(join_loading_points(parts), baseline_kpa)


def _convert_centred_cubic_to_c1_c2_c3(coefficients: Sequence[float]) -> Floats:
    """Convert a cubic in u = 2 x - 1 to c1, c2, c3 in x = gauge / range."""
    return np.asarray(np.linalg.solve(_U_OF_X, np.array(coefficients[1:])))


def _select_best_soak(soaks: Sequence[TemperatureEffect | str]) -> TemperatureEffect | str:
    """Return the effect with the least uncertain rise, else the last soak's reason."""
    effects = [soak for soak in soaks if isinstance(soak, TemperatureEffect)]
    return min(effects, key=lambda effect: effect.kpa_per_k.sigma) if effects else soaks[-1]


_BEFORE_S = 0.02  # shown before the event
_AFTER_S = 0.1  # the gas cools within it; a longer loading is a hold


@dataclass(frozen=True)
class ReplaySection:
    """Section of a rig recording around a release or a tap; arrays of m readings.

    Attributes:
        t_s: from the event.
        measured_kpa: gauge pressure, NaN where there is none.
        static_kpa: modelled with the static curve alone.
        modelled_kpa: modelled with all effects, with the loading's gain.
    """

    t_s: Floats
    measured_kpa: Floats
    static_kpa: Floats
    modelled_kpa: Floats


def simulate_release_and_tap_pressure(
    recordings: Sequence[Indentation], tile: TileCalibration
) -> dict[str, ReplaySection]:
    """Replay a "release" and a "tap" of the tile with its models; empty without any.

    The second of several, because the dome has settled by then.
    """
    if not any(np.isin(recording.phase, ("release", "tap")).any() for recording in recordings):
        return {}
    points, baseline_kpa = collect_loadings_at_common_baseline(recordings)
    effects = tile.effects
    # The mean curve of slow strokes contains creep and loop.
    static = DomeModel(
        _convert_centred_cubic_to_c1_c2_c3(tile.coefficients),
        tile.range_kpa[1],
        baseline_kpa,
        effects.wall_compliance_or_default_per_kpa,
    )
    model = _make_dome_model(effects, tile, baseline_kpa)
    late_s = effects.reference_late_s
    late_s += 0.0 if effects.late_s is None else effects.late_s.value
    force_n = make_clamped_pchip_force(points.t_s, points.force_n)(points.t_s + late_s)
    static_kpa, modelled_kpa = (
        each.compute_response(points.t_s, force_n).kpa - baseline_kpa for each in (static, model)
    )
    measured_kpa = points.kpa - baseline_kpa
    found: dict[str, ReplaySection] = {}
    for name, centre in _find_event_readings(
        points.t_s, points.force_n, points.loading, points.is_fast
    ).items():
        here = points.loading == points.loading[centre]
        # Each loading has its own gain, about one, fitted to its own readings.
        usable = here & np.isfinite(measured_kpa)
        square = float((modelled_kpa[usable] ** 2).sum())
        product = float((modelled_kpa[usable] * measured_kpa[usable]).sum())
        gain = product / square if square > 0.0 else 1.0
        t_s = points.t_s - points.t_s[centre]
        rows = (t_s >= -_BEFORE_S) & (t_s <= _AFTER_S)
        found[name] = ReplaySection(
            t_s[rows], measured_kpa[rows], static_kpa[rows], gain * modelled_kpa[rows]
        )
    return found


def _find_event_readings(
    t_s: Floats, force_n: Floats, loading: Ints, fast: Bools
) -> dict[str, int]:
    """Return the reading of the second release, and of the second tap."""
    held: list[int] = []
    tapped: list[int] = []
    for number in np.unique(loading[fast]):
        rows = np.flatnonzero(loading == number)
        borne = rows[force_n[rows] > 0.5 * force_n[rows].max()]
        if len(borne) < 2:
            continue
        long = t_s[borne[-1]] - t_s[borne[0]] > _AFTER_S
        # The end of a hold, where the force begins to fall; the peak of a tap.
        (held if long else tapped).append(
            int(borne[-1]) if long else int(borne[np.argmax(force_n[borne])])
        )
    return {
        name: places[min(1, len(places) - 1)]
        for name, places in (("release", held), ("tap", tapped))
        if places
    }

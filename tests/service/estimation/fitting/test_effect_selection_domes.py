"""Effects that a rig recording determines of an emulated dome: its own, and no others.

The emulated dome shares neither equations nor numbers with the model that is fitted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.emulation.dome_physics import Domes
from devices.emulation.parts import DomeProperties, draw_dome
from devices.emulation.surroundings import Surroundings
from devices.scene.emulation_sections import EmulationSection
from service.estimation.effects import EffectName
from service.estimation.models.hysteresis import WIDTHS_N
from tests.service.estimation.fitting.recordings import Press, fit_effects, record

pytestmark = pytest.mark.slow
soak = pytest.mark.soak

ALL = {"gas": True, "rubber": True, "hysteresis": True}


def emulate_dome(part: DomeProperties, **effects: bool) -> Press:
    """Return the pressures of an emulated dome without the effects set to False."""

    def press(t_s: np.ndarray, force_n: np.ndarray) -> np.ndarray:
        class Spindle:
            def forces_n(self, at_s: np.ndarray) -> np.ndarray:
                return np.array(np.interp(at_s, t_s, force_n))[:, None]

        scene = EmulationSection.model_validate(ALL | effects)
        domes = Domes([part], ["T01"], Spindle(), scene, Surroundings(scene), label="rig")
        return np.array([domes.compute_pressure_kpa(0, float(t)) for t in t_s])

    return press


def test_all_effects_of_a_dome_are_found_in_their_size() -> None:
    part = draw_dome("T02", 0)
    effects = fit_effects(record(emulate_dome(part), scatter=0.0))
    assert set(effects.refused) == {"temperature", "ambient"}
    assert effects.gas is not None
    assert 1.1 < effects.gas.gamma.value < 1.4
    # Conduction in a sphere has quicker modes than its slowest, which is gamma tau.
    gamma_tau_s = effects.gas.gamma.value * effects.gas.tau_s.value
    assert 0.5 * part.conduction_s < gamma_tau_s < 1.1 * part.conduction_s
    assert effects.rubber is not None
    assert sum(p.value for p in effects.rubber.part) == pytest.approx(
        sum(part.creep_parts), rel=0.35
    )
    assert effects.hysteresis is not None
    width_n = sum(p.value * w for p, w in zip(effects.hysteresis.part, WIDTHS_N, strict=True))
    assert width_n == pytest.approx(part.loop_n, rel=0.35)


def test_the_flowing_part_of_a_loop_is_found() -> None:
    part = replace(draw_dome("T02", 0), loop_n=0.1, viscous_n=0.3)
    effects = fit_effects(record(emulate_dome(part), scatter=0.0))
    assert effects.hysteresis is not None
    flow = effects.hysteresis.flow
    assert flow is not None
    # As wide as `viscous_n` at 7.5 N/s; a stroke of 10 N/s is wider by the fourth root.
    assert flow.stress_n.value == pytest.approx(0.3 * (10.0 / 7.5) ** 0.25, rel=0.2)
    assert 0.04 < flow.part.value < 0.12


@pytest.mark.parametrize("late_s", [-300e-6, 233e-6])
@pytest.mark.parametrize(
    "serial", ["T01", *(pytest.param(other, marks=soak) for other in ("T03", "T04", "T05"))]
)
def test_a_dome_with_a_delay_keeps_its_gas(serial: str, late_s: float) -> None:
    press = emulate_dome(draw_dome(serial, 0))
    effects = fit_effects(record(press, scatter=0.0, late_s=late_s))
    assert set(effects.refused) == {"temperature", "ambient"}
    assert effects.gas is not None
    assert effects.gas.gamma.value <= 1.4
    assert effects.late_s is not None
    assert effects.late_s.value == pytest.approx(late_s, abs=200e-6)


@pytest.mark.slow(parts=8)
@pytest.mark.parametrize("gamma_tau_s", [0.036, 0.012])
@pytest.mark.parametrize("seed", [0, *(pytest.param(other, marks=soak) for other in (1, 2))])
def test_a_gas_that_cools_as_fast_as_the_rubber_creeps_is_found(
    gamma_tau_s: float, seed: int
) -> None:
    drawn = draw_dome("T01", seed)
    part = replace(
        drawn,
        conduction_s=gamma_tau_s,
        creep_parts=(0.05, 0.03, 0.03),
        creep_s=(0.03, 0.4, 3.0),
    )
    effects = fit_effects(record(emulate_dome(part), scatter=0.02, late_s=233e-6, seed=seed))
    assert set(effects.refused) == {"temperature", "ambient"}
    assert effects.gas is not None
    assert 1.15 < effects.gas.gamma.value <= 1.4
    assert effects.rubber is not None
    total = sum(p.value for p in effects.rubber.part)
    assert total == pytest.approx(0.11, rel=0.5)


@pytest.mark.slow(parts=8)
def test_a_quick_gas_is_found_beside_flowing_rubber() -> None:
    # Its time and gamma compensate each other: neither is known well.
    part = replace(
        draw_dome("T01", 0),
        kappa=0.18 / 1.18,
        conduction_s=0.0063,
        creep_parts=(0.024, 0.041),
        creep_s=(0.011, 1.85),
        loop_n=0.05,
        viscous_n=0.31,
    )
    effects = fit_effects(record(emulate_dome(part), scatter=0.01))
    assert effects.gas is not None
    assert 1.03 < effects.gas.gamma.value < 1.25
    assert effects.gas.gamma.value - 1.0 < 5.0 * effects.gas.gamma.sigma
    assert effects.hysteresis is not None
    assert effects.hysteresis.flow is not None


@pytest.mark.slow(parts=8)
def test_creep_over_seconds_is_no_flow() -> None:
    part = replace(
        draw_dome("T01", 0),
        creep_parts=(0.002, 0.003, 0.019, 0.009),
        creep_s=(0.084, 0.363, 1.078, 3.515),
        loop_n=0.0,
    )
    effects = fit_effects(record(emulate_dome(part), scatter=0.01))
    assert effects.hysteresis is None
    assert effects.rubber is not None
    assert sum(p.value for p in effects.rubber.part) == pytest.approx(0.033, abs=0.015)


@pytest.mark.slow(parts=8)
@pytest.mark.parametrize(
    ("parts", "times_s", "terms"),
    [
        ((0.08,), (0.5,), {1, 2}),
        ((0.05, 0.05), (0.05, 2.0), {2}),
        ((0.04, 0.04, 0.04), (0.03, 0.4, 4.0), {3}),
        ((0.03, 0.03, 0.04, 0.04), (0.015, 0.1, 0.8, 6.0), {3}),
    ],
)
def test_creep_has_as_many_terms_as_the_rig_determines(
    parts: tuple[float, ...], times_s: tuple[float, ...], terms: set[int]
) -> None:
    part = replace(draw_dome("T02", 0), creep_parts=parts, creep_s=times_s)
    effects = fit_effects(record(emulate_dome(part), scatter=0.01))
    assert effects.rubber is not None
    assert len(effects.rubber.part) in terms
    # Creep after 0.1 s and after a second matters.
    for at_s in (0.1, 1.0):
        found = sum(
            g.value * np.exp(-at_s / tau.value)
            for g, tau in zip(effects.rubber.part, effects.rubber.tau_s, strict=True)
        )
        true = sum(g * np.exp(-at_s / tau) for g, tau in zip(parts, times_s, strict=True))
        assert found == pytest.approx(true, abs=0.012)


@pytest.mark.parametrize("missing", ["gas", "rubber", "hysteresis"])
def test_an_effect_that_a_dome_lacks_is_refused_with_a_reason(
    missing: EffectName,
) -> None:
    press = emulate_dome(draw_dome("T02", 0), **{missing: False})
    effects = fit_effects(record(press, scatter=0.0, strokes=2, holds=2, taps=6))
    assert getattr(effects, missing) is None
    assert effects.refused[missing].endswith(("not determined", " N"))
    for name in ALL:
        assert (getattr(effects, name) is None) == (name == missing), name

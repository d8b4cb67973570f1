"""The first frames of a stream: what a dome bore before is not known, unless it bears nothing."""

from __future__ import annotations

import numpy as np
import pytest

from devices.arrays import Bools, Floats
from devices.flags import EstimateFlag
from devices.frames import FrameBatch
from service.estimation.pipeline.plan import EstimationPlan
from service.estimation.records import Estimates
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import cut_up, loaded_frames

ARRAY = make_array(1)
COUNT_N = 0.04
RATE_HZ = 1e9 / PERIOD_NS
KNOWN = make_effects()
assert KNOWN.rubber is not None
RUBBER = KNOWN.rubber.model_copy(update={"coefficients": (0.0, COUNT_N, 0.0, 0.0)})
EFFECTS = make_effects(rubber=RUBBER)
LOOP = EFFECTS.hysteresis
LONG_S = 20.0
"""Ten times the longest time constant, and more."""


def plan(*models: str) -> EstimationPlan:
    """A tile of 0.04 N a count, so that a count of noise moves no loop."""
    tile = newton_tile("T01", effects=EFFECTS, coefficients=(0.0, COUNT_N, 0.0, 0.0))
    return newton_plan(ARRAY, sigma_n=0.5, models=("unwrap", "static", *models), tiles=[tile])


def apparent(force_n: Floats) -> Floats:
    """Apparent force of a dome with the creep and the loop of `EFFECTS`."""
    assert LOOP is not None
    fractions = [each.value for each in RUBBER.part]
    decays = [np.exp(-1.0 / (RATE_HZ * each.value)) for each in RUBBER.tau_s]
    widths_n, weights = (0.6, 1.5, 4.0), [each.value for each in LOOP.part]
    crept, plays, found = [0.0, 0.0], [0.0, 0.0, 0.0], []
    for now_n in force_n.tolist():
        halves = [min(width_n, 0.4 * now_n) for width_n in widths_n]
        plays = [
            min(max(play, now_n - half), now_n + half)
            for play, half in zip(plays, halves, strict=True)
        ]
        crept = [d * z + (1.0 - d) * now_n for d, z in zip(decays, crept, strict=True)]
        rubber_n = now_n - sum(g * (now_n - z) for g, z in zip(fractions, crept, strict=True))
        found.append(rubber_n + sum(w * (y - now_n) for w, y in zip(weights, plays, strict=True)))
    return np.array(found)


def held(*steps: tuple[float, float]) -> Floats:
    """Loads in N, each for so many seconds."""
    return np.concatenate([np.full(round(s * RATE_HZ), force_n) for force_n, s in steps])


def read(apparent_n: Floats) -> FrameBatch:
    """Frames with these apparent forces, rounded to a count up or down at random."""
    counts = apparent_n / COUNT_N
    whole = np.floor(counts)
    up = np.random.default_rng(1).random(len(counts)) < counts - whole
    return loaded_frames((whole + up)[:, None])


def begun(force_n: Floats, begin_s: float) -> tuple[Estimates, Floats]:
    """Estimates of a stream that begins at an instant of a load, and the load from there on."""
    first = round(begin_s * RATE_HZ)
    found = estimate(plan("rubber", "hysteresis"), read(apparent(force_n)[first:]))
    return found, force_n[first:]


def says_unknown(found: Estimates) -> Bools:
    return np.asarray((found.estimate_flags & EstimateFlag.HISTORY_UNKNOWN) != 0)


def averaged(values: Floats, s: float) -> float:
    return float(values[: round(s * RATE_HZ)].mean())


HISTORIES = {
    "standing for long": (held((0.0, 1.0), (3.0, LONG_S + 5.0)), LONG_S),
    "put down just now": (held((0.0, LONG_S), (3.0, 5.0)), LONG_S),
    "after a larger load": (held((0.0, 1.0), (4.5, LONG_S), (1.5, 5.0)), LONG_S + 1.0),
    "lifted just now": (held((0.0, 1.0), (4.5, LONG_S), (0.0, 5.0)), LONG_S + 1.0),
}


@pytest.mark.parametrize("history", HISTORIES)
def test_whatever_a_foot_bore_before_its_force_is_within_its_interval(history: str) -> None:
    found, true_n = begun(*HISTORIES[history])
    error_n = found.grf_n - true_n
    for seconds in (0.05, 0.5, 5.0):
        # The mean of many frames: noise is not at issue.
        assert abs(averaged(error_n, seconds)) < 1.96 * averaged(found.grf_sigma_n, seconds)
    assert says_unknown(found)[0]


def test_a_foot_that_has_stood_for_long_weighs_what_it_does_from_the_first_frame() -> None:
    found, true_n = begun(*HISTORIES["standing for long"])
    assert averaged(found.grf_n - true_n, 0.2) == pytest.approx(0.0, abs=0.025)


def test_the_unknown_history_passes_with_the_models_memory() -> None:
    found, _ = begun(*HISTORIES["standing for long"])
    first, last = found.grf_sigma_n[:20].mean(), found.grf_sigma_n[-20:].mean()
    assert first > 1.5 * last  # the rest is of the loop, which no time closes


def test_a_step_closes_the_loop_of_which_the_branch_was_unknown() -> None:
    true_n = held((0.0, 1.0), (3.0, LONG_S), (0.0, 6.0), (3.0, 1.0))
    found, _ = begun(true_n, LONG_S)
    assert says_unknown(found)[0]
    assert not says_unknown(found)[-100:].any()


def test_a_foot_in_the_air_has_no_unknown_history() -> None:
    found = estimate(plan("rubber", "hysteresis"), read(apparent(held((0.0, 1.0), (3.0, 1.0)))))
    assert not says_unknown(found).any()
    assert (found.grf_sigma_n[:400] == found.grf_sigma_n[0]).all()


def test_saturation_takes_over_from_the_unknown_history() -> None:
    force_n = held((3.0, 0.5), (8.0, 0.1), (3.0, 0.5))
    found = estimate(plan("rubber", "hysteresis"), read(force_n))
    assert says_unknown(found)[:100].all()
    assert not says_unknown(found)[-100:].any()
    assert (found.estimate_flags[-100:] & EstimateFlag.AFTER_SATURATION).all()


def test_a_tile_that_is_silent_at_first_begins_with_its_first_reading() -> None:
    force_n = np.where(np.arange(600) < 100, np.nan, 60.0)
    found = estimate(plan("rubber"), loaded_frames(force_n[:, None]))
    assert says_unknown(found)[100]


def test_gas_under_load_may_have_been_squeezed_just_now() -> None:
    loaded, unloaded = (estimate(plan("gas"), read(np.full(200, n))) for n in (2.4, 0.0))
    assert loaded.grf_sigma_n[0] > 5.0 * loaded.grf_sigma_n[-1]
    assert unloaded.grf_sigma_n[0] == unloaded.grf_sigma_n[-1]


def test_an_unknown_history_is_the_same_in_any_batches() -> None:
    frames = read(held((3.0, 1.0), (0.0, 0.5), (2.0, 0.5)))
    models = plan("rubber", "hysteresis")
    one, other = estimate(models, frames), estimate(models, *cut_up(frames, (1, 2, 500)))
    np.testing.assert_array_equal(one.grf_n, other.grf_n)
    np.testing.assert_array_equal(one.grf_sigma_n, other.grf_sigma_n)
    np.testing.assert_array_equal(one.estimate_flags, other.estimate_flags)

"""Steps of a calibration with weights follow from what the tile reads."""

from __future__ import annotations

import numpy as np
import pytest

from service.server.weighing import HOLD_S, REST_S, Begin, MarkerChange, Weighing, Withdraw

RATE_HZ = 100
EMPTY_KPA = 100.0


class Tile:
    """A tile whose pressure a test sets, read by a weighing of two weights."""

    def __init__(self) -> None:
        self.weighing = Weighing("T01", ["500 g", "1 kg"])
        self._readings = 0
        self._rng = np.random.default_rng(1)

    def waits(self, seconds: float) -> None:
        """Have nothing read for so long."""
        self._readings += round(seconds * RATE_HZ)

    def reads(self, kpa: float, seconds: float, *, per_s: float = 0.0) -> list[MarkerChange]:
        """Have it read so much for so long, rising or falling; what was done."""
        n = round(seconds * RATE_HZ)
        since_s = np.arange(n) / RATE_HZ
        t_ns = (self._readings + np.arange(n)) * (1_000_000_000 // RATE_HZ)
        self._readings += n
        noise_kpa = 0.15 * self._rng.standard_normal(n)
        return self.weighing.feed_tile_pressures(
            t_ns, EMPTY_KPA + kpa + per_s * since_s + noise_kpa
        )


def labels(actions: list[MarkerChange]) -> list[str]:
    """What is marked and withdrawn, in short."""
    return [
        action.label if isinstance(action, Begin) else type(action).__name__ for action in actions
    ]


def test_each_weight_is_held_between_rests() -> None:
    tile = Tile()
    done = tile.reads(0.0, REST_S + 2.0)
    done += tile.reads(3.0, HOLD_S + 2.0)
    done += tile.reads(0.1, REST_S + 2.0)  # the rubber has not gone back yet
    assert tile.weighing.prompt == "Put 1 kg on T01"
    done += tile.reads(5.0, HOLD_S + 2.0)
    steps = ["T01 rest", "End", "T01 500 g", "End", "T01 rest", "End", "T01 1 kg", "End"]
    assert labels(done) == steps
    t_ns = [action.t_ns for action in done if not isinstance(action, Withdraw)]
    lasts_s = [1e-9 * (end - begin) for begin, end in zip(t_ns[::2], t_ns[1::2], strict=True)]
    assert lasts_s == pytest.approx([REST_S, HOLD_S, REST_S, HOLD_S], abs=0.2)
    assert tile.weighing.step == "done"
    assert tile.weighing.repeatability is not None
    assert abs(tile.weighing.repeatability.mean_kpa - 4.9) < 0.1


def test_a_weight_that_moves_is_held_once_more() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    assert labels(tile.reads(3.0, 3.0)) == ["T01 500 g"]
    (withdrawn,) = tile.reads(0.0, 1.0)
    assert isinstance(withdrawn, Withdraw)
    assert tile.weighing.weight_index == 0
    assert labels(tile.reads(3.0, HOLD_S + 2.0)) == ["T01 500 g", "End"]


def test_a_load_that_looked_like_a_rest_is_none() -> None:
    tile = Tile()
    assert labels(tile.reads(4.0, REST_S + 2.0)) == ["T01 rest", "End"]
    withdrawn, *again = tile.reads(0.0, REST_S + 2.0)
    assert isinstance(withdrawn, Withdraw)
    assert labels(again) == ["T01 rest", "End"]


def test_nothing_begins_while_the_pressure_still_rises() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    assert tile.reads(1.0, 4.0, per_s=1.0) == []


def test_creep_is_no_movement() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    assert labels(tile.reads(3.0, HOLD_S + 2.0, per_s=0.05)) == ["T01 500 g", "End"]


def test_readings_that_are_missing_delay_a_step_and_do_not_end_it() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    assert tile.reads(np.nan, 3.0) == []
    assert labels(tile.reads(3.0, HOLD_S + 2.0)) == ["T01 500 g", "End"]


def test_a_step_that_was_not_watched_throughout_is_repeated() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    tile.reads(3.0, 3.0)
    tile.waits(1.5)
    done = tile.reads(3.0, HOLD_S + 2.0)
    assert labels(done) == ["Withdraw", "T01 500 g", "End"]


def test_a_weight_that_was_another_one_is_repeated_from_its_rest_on() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    tile.reads(5.0, HOLD_S + 2.0)
    tile.reads(0.0, REST_S + 2.0)
    assert tile.weighing.weight_index == 1
    assert labels(tile.weighing.repeat_held_or_last_weight()) == [
        "Withdraw",
        "Withdraw",
    ]  # the rest, and the weight
    assert tile.weighing.weight_index == 0
    done = tile.reads(0.0, REST_S + 2.0) + tile.reads(3.0, HOLD_S + 2.0)
    assert labels(done) == ["T01 rest", "End", "T01 500 g", "End"]


def test_a_weight_that_is_repeated_while_it_is_held_is_no_rest() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    tile.reads(5.0, 3.0)
    assert labels(tile.weighing.repeat_held_or_last_weight()) == ["Withdraw"]
    assert tile.reads(5.0, REST_S + 2.0) == []
    assert tile.weighing.prompt == "Take everything off T01"
    assert labels(tile.reads(0.0, REST_S + 2.0)) == ["T01 rest", "End"]

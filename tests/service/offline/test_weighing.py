"""Steps of a calibration with weights follow from what the tile reads."""

from __future__ import annotations

import numpy as np

from service.offline.weighing import HOLD_S, REST_S, Action, Begin, End, Weighing, Withdraw

RATE_HZ = 100
EMPTY_KPA = 100.0


class Tile:
    """A tile whose pressure a test sets, read by a weighing of two weights."""

    def __init__(self) -> None:
        self.weighing = Weighing("T01", ["500 g", "1 kg"])
        self._readings = 0
        self._rng = np.random.default_rng(1)

    def reads(self, kpa: float, seconds: float, *, per_s: float = 0.0) -> list[Action]:
        """Have it read so much for so long, rising or falling; what was done."""
        n = round(seconds * RATE_HZ)
        since_s = np.arange(n) / RATE_HZ
        t_s = (self._readings + np.arange(n)) / RATE_HZ
        self._readings += n
        noise_kpa = 0.15 * self._rng.standard_normal(n)
        return self.weighing.push(t_s, EMPTY_KPA + kpa + per_s * since_s + noise_kpa)


def test_each_weight_is_held_between_rests() -> None:
    tile = Tile()
    done = tile.reads(0.0, REST_S + 2.0)
    done += tile.reads(3.0, HOLD_S + 2.0)
    done += tile.reads(0.1, REST_S + 2.0)  # the rubber has not gone back yet
    assert tile.weighing.prompt.startswith("Put 1 kg on tile T01 (2 of 2)")
    done += tile.reads(5.0, HOLD_S + 2.0)
    rest, first, second = Begin("T01 rest"), Begin("T01 500 g"), Begin("T01 1 kg")
    assert done == [rest, End(), first, End(), rest, End(), second, End()]
    assert tile.weighing.step == "done"
    assert tile.weighing.repeatability is not None
    assert abs(tile.weighing.repeatability.mean_kpa - 4.9) < 0.1


def test_a_weight_that_moves_is_held_once_more() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    assert tile.reads(3.0, 3.0) == [Begin("T01 500 g")]
    (withdrawn,) = tile.reads(0.0, 1.0)
    assert isinstance(withdrawn, Withdraw)
    assert tile.weighing.number == 0
    assert tile.reads(3.0, HOLD_S + 2.0) == [Begin("T01 500 g"), End()]


def test_a_load_that_looked_like_a_rest_is_none() -> None:
    tile = Tile()
    assert tile.reads(4.0, REST_S + 2.0) == [Begin("T01 rest"), End()]
    withdrawn, *again = tile.reads(0.0, REST_S + 2.0)
    assert isinstance(withdrawn, Withdraw)
    assert again == [Begin("T01 rest"), End()]


def test_nothing_begins_while_the_pressure_still_rises() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    assert tile.reads(1.0, 4.0, per_s=1.0) == []


def test_creep_is_no_movement() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    assert tile.reads(3.0, HOLD_S + 2.0, per_s=0.05) == [Begin("T01 500 g"), End()]


def test_readings_that_are_missing_delay_a_step_and_do_not_end_it() -> None:
    tile = Tile()
    tile.reads(0.0, REST_S + 2.0)
    assert tile.reads(np.nan, 3.0) == []
    assert tile.reads(3.0, HOLD_S + 2.0) == [Begin("T01 500 g"), End()]

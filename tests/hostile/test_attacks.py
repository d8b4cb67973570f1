"""Every attack of the list, with few tries; with `--soak` as many as in docs/results/hostile.md.

FOOTTILE_TURN in the environment: a number that every run of all tests has to itself.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path

import pytest

from tests.conftest import PARTS
from tests.hostile.__main__ import played
from tests.hostile.attack import ATTACKS, Attack, Outcome, Play

SEED = 1
TURN = int(os.environ.get("FOOTTILE_TURN", "0"))

for _path in sorted(Path(__file__).parent.glob("attack_*.py")):
    importlib.import_module(f"tests.hostile.{_path.stem}")


@pytest.mark.process
@pytest.mark.slow
@pytest.mark.parametrize(
    "attack",
    [
        pytest.param(attack, marks=[pytest.mark.real_time] if attack.is_alone else [], id=name)
        for name, attack in ATTACKS.items()
    ],
)
def test_an_attack_does_nothing_that_it_must_not(attack: Attack, tmp_path: Path) -> None:
    outcome = attack.play(seed=SEED, is_soak=False, folder=tmp_path, turn=TURN // PARTS)
    assert outcome.tries >= attack.tries
    assert outcome.failures == []


def _raising(error: BaseException) -> Attack:
    def run(_: Play) -> Outcome:
        raise error

    return Attack("test", 1, 1, run)


@pytest.mark.parametrize(
    "error",
    [pytest.skip.Exception("no browser"), pytest.fail.Exception("no"), TimeoutError()],
    ids=str,
)
def test_an_attack_that_could_not_be_played_is_a_failure_and_does_not_end_the_run(
    error: BaseException,
) -> None:
    (why,) = played(_raising(error), seed=SEED, is_soak=False).failures
    assert why == f"not played: {str(error) or 'TimeoutError'}"


@pytest.mark.process
@pytest.mark.soak
@pytest.mark.parametrize("attack", ATTACKS.values(), ids=list(ATTACKS))
def test_many_tries_of_it_do_not_either(attack: Attack, tmp_path: Path) -> None:
    outcome = attack.play(seed=SEED, is_soak=True, folder=tmp_path)
    assert outcome.tries >= attack.soak_tries
    assert outcome.failures == []

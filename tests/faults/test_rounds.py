"""Rounds of faults, a part of them in every run of the tests, and kills at every call that matters.

`python tests/faults/rounds.py --rounds 200` plays many more.
"""

# ruff: noqa: S311  # seeded on purpose

from __future__ import annotations

import os
import random
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from tests.faults.checks import findings, sessions_are_whole
from tests.faults.draws import RandomDraws
from tests.faults.machines import RoundError, wait_for
from tests.faults.power import read_tree
from tests.faults.rounds import play
from tests.faults.stage import Stage
from tests.faults.stories import (
    ALONE,
    ANYTIME,
    AT_THE_END,
    AT_THE_END_ALONE,
    FULL,
    Fault,
    Story,
    draw_story,
)
from tests.waiting import PATIENCE_S

CALLS = "fsync+replace"
SYNCS = ("fsync@journal/:1:before", "fsync@journal/:2:after", "fsync@journal/:3:before")
_CALLS_MAX = 40
_DRAWS = 20

STORIES = {
    "kills": ("kill_node", "kill_server", "kill_acquisition", "kill_node_parent"),
    "kills of both": ("restart_node_twice", "kill_both", "kill_while_sealing"),
    "power": ("power_node", "power_server", "power_both", "power_while_sealing"),
    "link": ("cut_link", "throttle_link", "delay_link", "stop_while_away"),
    "flipped bits": ("corrupt_link",),
    "times": ("clock_of_node", "clock_of_server", "slow_fsync", "black_hole"),
    "held up": ("hold_up_node", "hold_up_server"),
    "full": ("full_disk_of_server",),
    "full node": ("full_disk_of_node",),
    "away": ("black_hole", "stop_while_away_and_kill_node"),
}
IN_EVERY_RUN = ("kills", "power")
STORIES_ALONE = {
    "alone, kills": ("kill_node", "kill_acquisition", "kill_node_parent", "restart_node_twice"),
    "alone, power": ("power_node", "clock_of_node", "slow_fsync"),
    "alone, held up": ("hold_up_node",),
    "alone, killed at the end": ("kill_and_recover",),
    "alone, no power at the end": ("power_and_recover",),
}


def test_the_chosen_stories_show_every_kind_of_fault() -> None:
    assert {kind for kinds in STORIES.values() for kind in kinds} == {*ANYTIME, *AT_THE_END, *FULL}
    alone = {kind for kinds in STORIES_ALONE.values() for kind in kinds}
    assert alone == {*ALONE, *AT_THE_END_ALONE}


def test_a_seed_is_a_story_and_nobody_is_asked_to_fill_a_disk_who_may_not() -> None:
    drawn = [draw_story(seed, may_mount=True) for seed in range(500)]
    assert drawn == [draw_story(seed, may_mount=True) for seed in range(500)]
    kinds = {fault.kind for story in drawn for fault in story.faults}
    assert kinds == {*ANYTIME, *AT_THE_END, *FULL, *ALONE, *AT_THE_END_ALONE}
    modest = [draw_story(seed, may_mount=False) for seed in range(500)]
    assert not any(story.small_disk_of for story in modest)


@pytest.mark.real_time
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in IN_EVERY_RUN else pytest.mark.slow)
        for name in (*STORIES, *STORIES_ALONE)
    ],
)
def test_a_chosen_round_is_good(name: str, tmp_path: Path) -> None:
    if name.startswith("full") and os.geteuid() != 0:
        pytest.skip("to mount a small disk one has to be root")
    kinds = STORIES.get(name) or STORIES_ALONE[name]
    number = [*STORIES, *STORIES_ALONE].index(name)
    rng = random.Random(number)
    faults = tuple(
        Fault(
            kind,
            after_s=rng.uniform(0.2, 0.8),
            length_s=rng.uniform(0.1, 1.0),
            # So many flipped bits that some are sure to be in frames.
            amount=0.0 if kind == "corrupt_link" else rng.random(),
        )
        for kind in kinds
    )
    story = Story(number, faults, pre_roll_s=0.3, alone=name in STORIES_ALONE)
    result = play(story, tmp_path / "round")
    assert not result.findings, result.line


# --- kills at chosen calls ------------------------------------------------------------------------


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    """A server, a node, and a session that is recorded for most of a second."""
    folder = tmp_path / "stage"
    folder.mkdir()
    with Stage(Story(seed=5, faults=()), folder) as made:
        made.begin()
        time.sleep(0.7)
        yield made


def judge(stage: Stage) -> None:
    """The session is what it has to be."""
    for facts in stage.end():
        assert not findings(facts), stage.log


def stop_until_it_dies(stage: Stage, call: str) -> bool:
    """Start the server, to be killed at this call, and stop the session; was it killed?"""
    server = stage.server
    server.kill()
    server.start(kill_at=call)

    def over() -> bool:
        with suppress(httpx.HTTPError, RoundError):
            state = server.get(f"/sessions/{stage.session_id}")["state"]
            if state == "recording":
                stage.wait_back()
                stage.stop()
            return bool(state == "sealed") or not server.is_alive
        return not server.is_alive

    wait_for("the session is sealed, or the server is killed", over, 40.0)
    return not server.is_alive


@pytest.mark.soak
@pytest.mark.real_time
@pytest.mark.parametrize(("when", "is_power"), [("before", False), ("after", True)])
def test_a_server_that_dies_at_each_call_of_stopping_and_sealing_leaves_every_session_whole(
    stage: Stage, when: str, is_power: bool
) -> None:
    rng = random.Random(5)
    number = 1
    while stop_until_it_dies(stage, f"{CALLS}@sessions/:{number}:{when}"):
        if not is_power:
            assert not sessions_are_whole(read_tree(stage.server.root), stage.session_id), number
        else:
            stage.server.kill()
            for _ in range(_DRAWS):
                tree = stage.server.disk.possible(RandomDraws(rng))
                assert not sessions_are_whole(tree, stage.session_id), number
            stage.server.cut_power(rng)
        number += 1
        assert number < _CALLS_MAX
    assert number > 6
    judge(stage)


@pytest.mark.real_time
@pytest.mark.slow
@pytest.mark.parametrize("how", [pytest.param("killed", marks=pytest.mark.soak), "power"])
def test_a_server_that_dies_at_syncs_of_its_journal_keeps_what_it_has_promised(
    stage: Stage, how: str
) -> None:
    rng = random.Random(6)
    server = stage.server
    for call in SYNCS:
        server.kill_at(call)
        wait_for("the server is killed", lambda: not server.is_alive, PATIENCE_S)
        server.kill()
        if how == "power":
            stage.note(f"{call}, power of the server: {server.cut_power(rng)}")
        server.start()
        server.wait_ready()
        stage.wait_back()
    judge(stage)


@pytest.mark.real_time
@pytest.mark.slow
@pytest.mark.parametrize("how", [pytest.param("killed", marks=pytest.mark.soak), "power"])
def test_a_node_killed_at_syncs_of_its_journal_loses_no_more_than_it_says(
    stage: Stage, how: str
) -> None:
    rng = random.Random(7)
    for call in ("any@journal/:1:before", "fsync@journal/:2:after", "fsync@journal/:1:before"):
        stage.node.kill_at(call)
        stage.end_node_when_it_dies(how, rng)
    judge(stage)

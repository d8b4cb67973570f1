"""What a reader is given when something seldom happens, and what encoded pieces are kept."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.arrays import Ints
from devices.errors import DamagedFramesError, FileFormatError, StorageError
from devices.frames import FrameBatch
from service.protocol.codec import CloseConnection, LinkCloseCode
from service.protocol.live import Policy
from service.server.estimates import live_estimator
from service.server.estimates.live_estimator import make_live_plan
from service.server.estimates.node_estimator import EstimatedBatch
from service.server.live_feed import reader as reader_module
from service.server.live_feed.events import (
    EncodeCache,
    FeedEvent,
    FrameRows,
    Gap,
    Position,
    StreamStart,
)
from service.server.live_feed.reader import FeedReader, RecomputedFrames
from service.sessions.estimate_stream import EstimateRun
from storage.journal.journal import Journal
from tests.builders.arrays import PERIOD_NS, UTC_NS
from tests.service.server.live_feed.world import WAITING, World, bits
from tests.waiting import until

FIRST, SECOND, THIRD = (f"{number:032x}" for number in range(3))


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    one = World(tmp_path)
    yield one
    one.close()


def all_of(world: World, reader: FeedReader) -> list[FeedEvent]:
    """What it is given until nothing is there."""
    items = []
    while (item := world.read(reader)) is not None:
        items.append(item)
    return items


def told(items: list[FeedEvent]) -> list[tuple[str, str, int, int]]:
    """Frames that came and frames that are left out, by stream, those of a kind together."""
    spans: list[tuple[str, str, int, int]] = []
    for item in items:
        if isinstance(item, StreamStart):
            continue
        kind = item.reason if isinstance(item, Gap) else "came"
        span = kind, item.stream_id, item.first_seq, item.last_seq
        if spans and spans[-1][:2] == span[:2] and spans[-1][3] + 1 == span[2]:
            span = *span[:2], spans.pop()[2], span[3]
        spans.append(span)
    return spans


def refused(world: World, reader: FeedReader) -> CloseConnection:
    with pytest.raises(CloseConnection) as end:
        all_of(world, reader)
    return end.value


# --- lossless -------------------------------------------------------------------------------------


def test_what_waits_for_its_look_ahead_comes_when_its_stream_has_ended(world: World) -> None:
    world.send_newest(40)
    world.restart()  # memory is empty
    world.connect()
    reader = world.reader("lossless", Position(FIRST, 0))
    ((_, _, _, last),) = told(all_of(world, reader))
    assert 40 - WAITING <= last + 1 < 40
    world.reboot()
    world.send_newest(20)
    (rest, (_, _, begin, _)) = told(all_of(world, reader))
    assert rest == ("came", FIRST, last + 1, 39)
    assert begin == 0


def test_frames_that_came_while_others_were_estimated_again_follow_them(world: World) -> None:
    world.send_newest(40)
    world.restart()
    world.connect()
    reader = world.reader("lossless", Position(FIRST, 0))
    assert isinstance(world.read(reader), FrameRows)
    world.node.receive_frames(  # they reach the journal, and no live picture
        world.node.present_stream, world.payload(40, 79), UTC_NS
    )
    ((_, _, _, last),) = told(all_of(world, reader))
    assert last + 1 >= 80 - WAITING


def test_a_stream_of_which_nothing_has_come_is_waited_for_after_a_restart(world: World) -> None:
    world.send_newest(20)
    world.leave()
    world.reboot()
    world.take(20)
    world.reboot()
    world.connect()  # it has told of the second stream
    world.restart()
    reader = world.reader("lossless", Position(SECOND, 0))
    assert all_of(world, reader) == []
    world.connect()
    world.send_lacking()
    assert told(all_of(world, reader))[0] == ("came", SECOND, 0, 19)


def test_after_a_stream_that_the_node_has_forgotten_comes_the_one_taken_then(world: World) -> None:
    world.send_newest(20)
    world.leave()
    world.reboot()
    world.take(20)
    world.reboot()
    del world.streams[FIRST]  # all of it was acknowledged
    world.restart()
    world.connect()
    world.send_lacking()
    items = all_of(world, world.reader("lossless", Position(FIRST, 0)))
    assert told(items)[:2] == [("came", FIRST, 0, 19), ("came", SECOND, 0, 19)]
    assert isinstance(items[-1], StreamStart)


def test_a_stream_that_is_deleted_while_it_is_read_ends_the_reader(tmp_path: Path) -> None:
    world = World(tmp_path, is_recording=False)
    world.send_newest(20)
    reader = world.reader("lossless", Position(FIRST, 0))
    world.forget()
    world.reboot()
    del world.streams[FIRST]
    world.connect()
    world.prune()
    world.send_newest(20)
    world.forget()
    assert refused(world, reader).code == LinkCloseCode.NO_STREAM
    world.close()


def test_estimates_of_a_stream_that_has_ended_are_the_bits_of_live(world: World) -> None:
    for _ in range(20):
        world.send_newest(10)
    # Its interval is over by then; it is in force from the next frame on.
    world.tare((world.node.last_t_ns or 0) - 50 * PERIOD_NS, counts=-5)
    for _ in range(20):
        world.send_newest(10)
    world.reboot()
    world.send_newest(20)
    world.forget()
    compared = 0
    for item in all_of(world, world.reader("lossless", Position(FIRST, 0))):
        if isinstance(item, FrameRows) and item.stream_id == FIRST:
            assert item.is_recomputed
            for row, seq in enumerate(item.batch[0].seq.tolist()):
                if (live := world.published.get((FIRST, seq))) is not None:
                    assert bits(item.batch[1], row) == live
                    compared += 1
    assert compared > 390


STATE, CUT, BACK, END = 4000, 5000, 5600, 6200
"""Numbers of the frames: of the only stored state, of the cut, of the link's return, of the end."""
NOISE = np.random.default_rng(3).normal(0.0, 1.0, (20_000, 2))


def walk_with_a_lost_baseline(seq: Ints) -> Ints:
    """Counts of a foot that steps once a second and whose first tile is pressed sideways early."""
    load = np.maximum(0.0, 25 * np.sin(2 * np.pi * seq / 500))
    pressed = np.where((seq > 1000) & (seq < 1600), 20, 0)
    load_n = np.stack([load - pressed, 0.8 * load], 1)
    return np.rint(500 - load_n + NOISE[seq]).astype(np.int64)


def store_states_every(frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a state stored every so many frames instead of every 30 s."""
    for module in (live_estimator, reader_module):
        monkeypatch.setattr(module, "STATE_PERIOD_NS", frames * PERIOD_NS)


@pytest.fixture
def cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    """A world whose link was cut for a second after ten seconds; the backlog is to come."""
    store_states_every(STATE, monkeypatch)
    world = World(tmp_path, models=("static", "denoise"))
    world.present.counts = walk_with_a_lost_baseline
    for _ in range(CUT // 100):
        world.send_newest(100)
    world.leave()
    world.take(BACK - CUT)
    world.connect()
    yield world
    world.close()


def estimates_of(items: list[FeedEvent]) -> dict[int, tuple[float, ...]]:
    """Bits of each estimate by its number, of frames that came."""
    return {
        seq: bits(item.batch[1], row)
        for item in items
        if isinstance(item, FrameRows)
        for row, seq in enumerate(item.batch[0].seq.tolist())
    }


def in_one_run(world: World) -> dict[int, tuple[float, ...]]:
    """Bits of all frames of the stream, estimated one after another."""
    live = world.node.estimator.live
    calibration, tare = live.calibration, live.tare_in_use_unless_lost
    assert calibration is not None
    assert tare is not None
    run = EstimateRun(make_live_plan(world.present.info, calibration, tare))
    pieces = chain(run.feed_frames(world.present.frames(0, END - 1), {}), run.flush())
    return {seq: bits(c, row) for f, c in pieces for row, seq in enumerate(f.seq.tolist())}


def test_late_frames_go_on_from_the_state_before_them_and_are_estimated_once(
    cut: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    fed: list[int] = []
    feed = EstimateRun.feed_frames

    def count(run: EstimateRun, frames: FrameBatch, carried: Any) -> Iterator[EstimatedBatch]:
        fed.extend(frames.seq.tolist())
        return feed(run, frames, carried)

    monkeypatch.setattr(EstimateRun, "feed_frames", count)
    reader = cut.reader("lossless", Position(FIRST, CUT - 10))
    items = all_of(cut, reader)
    for begin in range(CUT, BACK, 20):  # as over a slow link
        cut.send_newest(20)
        cut.send(begin, begin + 19)
        items += all_of(cut, reader)
    assert len(fed) <= 2 * (END - CUT) + (CUT - STATE)
    whole, found = in_one_run(cut), estimates_of(items)
    assert [seq for seq in range(CUT, BACK - WAITING) if found[seq] != whole[seq]] == []


def test_frames_of_live_are_as_they_were_also_behind_a_gap_that_was_filled(cut: World) -> None:
    for _ in range((END - BACK) // 100):
        cut.send_newest(100)
    cut.send(CUT, BACK - 1)
    cut.forget()
    live = [*range(STATE - 500, CUT - WAITING), *range(BACK, END - 100)]
    for first in (STATE - 500, STATE + 500, BACK + 200):
        found = estimates_of(all_of(cut, cut.reader("lossless", Position(FIRST, first))))
        numbers = [seq for seq in live if seq >= first]
        assert [seq for seq in numbers if found[seq] != cut.published[FIRST, seq]] == []


def walking(world: World, frames: int) -> World:
    """A world that has taken so many frames of the walk, none of them buffered any more."""
    world.present.counts = walk_with_a_lost_baseline
    for _ in range(frames // 100):
        world.send_newest(100)
    world.forget()
    return world


def test_a_replay_from_before_the_oldest_state_has_the_bits_of_live_behind_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_estimator, "_STATES_MAX", 2)
    store_states_every(1500, monkeypatch)
    world = walking(World(tmp_path, models=("static", "denoise")), 9000)
    oldest = min(e.seq for e in world.node.estimator.live.epochs.list_epochs() if e.state)
    found = estimates_of(all_of(world, world.reader("lossless", Position(FIRST, oldest - 500))))
    differ = [seq for seq, each in found.items() if each != world.published[FIRST, seq]]
    world.close()
    assert differ[:1] == [oldest - 500]  # it does not know of the lost baseline yet
    assert max(differ) < oldest


def test_frames_of_a_calibration_that_was_removed_are_replayed_with_it(tmp_path: Path) -> None:
    world = walking(World(tmp_path), 3000)
    world.calibration = None
    world.connect()
    walking(world, 200)
    found = estimates_of(all_of(world, world.reader("lossless", Position(FIRST, 1000))))
    numbers = range(1000, 3000 - WAITING)
    differ = [seq for seq in numbers if found[seq] != world.published[FIRST, seq]]
    world.close()
    assert differ == []


def test_tares_of_ended_streams_outlive_their_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store_states_every(1000, monkeypatch)
    world = walking(World(tmp_path), 2000)
    world.tare((world.node.last_t_ns or 0) - 50 * PERIOD_NS, counts=-5)
    walking(world, 500)
    for _ in range(2):
        world.reboot()
        walking(world, 100)
    items = all_of(world, world.reader("lossless", Position(FIRST, 0)))
    found = estimates_of([item for item in items if item.stream_id == FIRST])
    numbers = range(2500 - WAITING)
    differ = [seq for seq in numbers if found[seq] != world.published[FIRST, seq]]
    epochs = world.node.estimator.epochs_since_server_start(FIRST)
    world.close()
    assert differ == []
    assert [epoch.state for epoch in epochs] == [None, None]


def test_a_reader_that_is_served_from_the_buffer_again_holds_no_journal_open(world: World) -> None:
    walking(world, 3000)
    before = count_open_journals()
    reader = world.reader("lossless", Position(FIRST, 0))
    assert isinstance(world.read(reader), FrameRows)
    assert count_open_journals() > before
    world.memory._bytes_max = 1 << 20
    for _ in range(4):
        world.send_newest(10)
    all_of(world, reader)
    # A thread may hold the last result of its work for a moment.
    until(lambda: count_open_journals() == before)


def count_open_journals() -> int:
    """How many files of journals this process has open."""
    files = Path("/proc/self/fd").iterdir()
    return sum(os.readlink(each).endswith(".arrows") for each in files if each.is_symlink())


def test_of_another_scene_that_the_calibration_does_not_fit_frames_come_alone(world: World) -> None:
    world.send_newest(40)
    world.reboot()
    world.present.info = world.present.info.model_copy(update={"models": ("static",)})
    first = world.streams[FIRST]
    first.info = first.info.model_copy(update={"models": ("static", "rubber")})
    world.restart()
    world.connect()
    world.node.streams[FIRST].info = first.info
    (*_, last) = all_of(world, world.reader("lossless", Position(FIRST, 0)))[:1]
    assert isinstance(last, FrameRows)
    assert last.batch[1] == {}


# --- what is wrong on the disk --------------------------------------------------------------------


def test_of_damaged_frames_only_these_are_lost_and_those_before_and_behind_come(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(6):
        world.send_newest(10)
    world.forget_sent(60)
    world.restart()
    world.connect()
    damage(world, 25)
    items = all_of(world, world.reader("lossless", Position(FIRST, 0)))
    assert told(items)[:2] == [("came", FIRST, 0, 19), ("corrupt", FIRST, 20, 29)]
    assert told(items)[2][:3] == ("came", FIRST, 30)


def test_damaged_frames_that_the_node_still_has_come_once_more(world: World) -> None:
    for _ in range(6):
        world.send_newest(10)
    world.restart()
    world.connect()
    damage(world, 25)
    reader = world.reader("lossless", Position(FIRST, 0))
    items = all_of(world, reader)
    ((_, _, first, last),) = told(items)  # those before still wait for them, as look-ahead
    assert first == 0
    assert 20 - WAITING <= last + 1 < 20
    world.send_lacking()
    world.send_newest(20)
    items += all_of(world, reader)
    ((_, _, first, last),) = told(items)
    assert (first, last + 1) >= (0, 80 - WAITING)


def damage(world: World, seq: int) -> None:
    """Flip a bit in the message on disk that holds a frame."""
    for stream in world.node.streams.values():
        stream.close()
    (path,) = (world.folder / "journal" / FIRST).glob("*.arrows")
    content = bytearray(path.read_bytes())
    counts = world.present.frames(seq, seq + 3).pressure_raw.tobytes()
    content[content.index(counts)] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (StorageError("a bad sector", errno=errno.EIO), LinkCloseCode.TRY_LATER),
        (FileFormatError("no frames of this stream"), LinkCloseCode.UNREADABLE),
        (
            DamagedFramesError("in another folder", seq_first=3, seq_last=4),
            LinkCloseCode.UNREADABLE,
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_cannot_be_read_ends_the_reader_with_the_position_to_resume_from(
    world: World, monkeypatch: pytest.MonkeyPatch, error: Exception, code: LinkCloseCode
) -> None:
    world.send_newest(40)
    world.restart()
    world.connect()

    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(RecomputedFrames, "next_rows", fails)
    end = refused(world, world.reader("lossless", Position(FIRST, 3)))
    assert end.code == code
    assert end.reason.endswith(f"resume with stream_id={FIRST}&from_seq=3")
    assert len(end.reason) <= 123


def test_a_journal_that_cannot_be_read_now_is_not_taken_for_one_that_is_not_there(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.send_newest(40)
    world.reboot()
    world.send_newest(20)

    whole = Journal.open_existing_and_recover

    def opens(folder: Path, **how: object) -> Journal:
        if folder.name == FIRST:
            raise StorageError("no descriptor is left", errno=errno.EMFILE)
        return whole(folder, **how)  # type: ignore[arg-type]  # of several types

    monkeypatch.setattr(Journal, "open_existing_and_recover", opens)
    world.restart()
    world.connect()
    assert (
        refused(world, world.reader("lossless", Position(FIRST, 0))).code == LinkCloseCode.TRY_LATER
    )


# --- drop_oldest, latest --------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["drop_oldest", "latest"])
def test_what_is_left_out_of_streams_that_have_ended_is_said(world: World, policy: Policy) -> None:
    world.send_newest(40)
    reader = world.reader(policy, Position(FIRST, 0))
    first = told(all_of(world, reader))
    world.leave()
    world.reboot()
    world.take(20)
    world.reboot()
    world.take(15)
    world.connect()
    world.send_newest(30)
    (end,) = {last + 1 for kind, _, _, last in first if kind == "came"}
    at = told(all_of(world, reader))
    assert at[0] == ("late", FIRST, end, 39)
    assert at[1] == ("late", SECOND, 0, 19)
    assert at[2] == ("late", THIRD, 0, 14)
    assert at[3][:3] == ("came", THIRD, 15)


@pytest.mark.parametrize("policy", ["drop_oldest", "latest"])
def test_frames_that_come_once_more_after_a_restart_are_not_given_again(
    world: World, policy: Policy
) -> None:
    world.send_newest(40)
    world.restart()
    world.connect()
    reader = world.reader(policy, Position(FIRST, 60))
    world.send_newest(15)
    assert all_of(world, reader) == []
    world.send_newest(40)
    assert told(all_of(world, reader))[0][2] == 60


def test_latest_gives_the_newest_piece_and_says_what_lies_between(world: World) -> None:
    reader = world.reader("latest", Position(FIRST, 0))
    for _ in range(4):
        world.send_newest(10)
    missed, came = told(all_of(world, reader))
    assert missed == ("slow", FIRST, 0, came[2] - 1)


def test_what_was_used_least_lately_goes_and_no_more_is_kept_than_is_allowed() -> None:
    shared = EncodeCache(bytes_max=30)
    for key in range(3):
        shared.put(key, bytes(10))
    assert shared.get(0) is not None
    shared.put(3, bytes(10))
    assert [shared.get(key) is not None for key in range(4)] == [True, False, True, True]
    assert shared.size_bytes == 30
    shared.put("too much", bytes(100))
    assert shared.size_bytes == 0

"""What a node keeps: everything that is not acknowledged, up to a bound, and then it counts."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise

from hypothesis import given
from hypothesis import strategies as st

from service.backlog import Backlog, EncodedBatch, make_room

batches = st.lists(st.tuples(st.integers(1, 5), st.integers(0, 40)), max_size=30)
"""Frames and bytes of each batch."""


def filled(sizes: Sequence[tuple[int, int]], bytes_max: int = 1 << 20) -> Backlog:
    backlog = Backlog(bytes_max)
    for batch in made(sizes):
        backlog.append(batch)
    return backlog


def made(sizes: Sequence[tuple[int, int]]) -> list[EncodedBatch]:
    begins = accumulate((frames for frames, _ in sizes), initial=0)
    return [
        EncodedBatch(first, end - 1, bytes([n % 256]) * size)
        for n, ((first, end), (_, size)) in enumerate(zip(pairwise(begins), sizes, strict=True))
    ]


def numbers(backlog: Backlog, seq: int = 0) -> list[int]:
    return [n for b in backlog.since(seq) for n in range(b.seq_first, b.seq_last + 1)]


def test_a_new_backlog_has_nothing_and_begins_with_the_first_frame() -> None:
    backlog = Backlog()
    assert (backlog.first_seq, backlog.next_seq, backlog.evicted_frames) == (0, 0, 0)
    assert numbers(backlog) == []
    backlog.acknowledge(0, 100)
    assert backlog.first_seq == 0


@given(batches, st.integers(0, 160))
def test_since_gives_every_batch_with_frames_from_there_on_oldest_first(
    sizes: list[tuple[int, int]], seq: int
) -> None:
    backlog = filled(sizes)
    assert list(backlog.since(seq)) == [b for b in made(sizes) if b.seq_last >= seq]
    assert backlog.next_seq == sum(frames for frames, _ in sizes)
    assert backlog.evicted_frames == 0


@given(batches, st.integers(0, 200))
def test_the_bound_is_kept_the_newest_stay_and_what_is_evicted_is_counted(
    sizes: list[tuple[int, int]], bytes_max: int
) -> None:
    backlog = Backlog(bytes_max)
    for n, batch in enumerate(made(sizes)):
        backlog.append(batch)
        kept = list(backlog.since(0))
        assert kept == made(sizes[: n + 1])[-len(kept) :]
        held = sum(len(b.payload) for b in kept)
        assert held <= bytes_max or len(kept) == 1  # the newest stays, whatever its size
        assert backlog.evicted_frames == kept[0].seq_first == backlog.first_seq
        # Nothing goes before it has to: with the next older one it would be too much.
        if len(kept) <= n:
            assert held + sizes[n - len(kept)][1] > bytes_max or held > bytes_max


@given(batches, st.integers(0, 160), st.integers(0, 160))
def test_only_what_is_acknowledged_as_a_whole_is_forgotten(
    sizes: list[tuple[int, int]], first: int, last: int
) -> None:
    backlog = filled(sizes)
    backlog.acknowledge(first, last)
    acknowledged = [b for b in made(sizes) if first <= b.seq_first and b.seq_last <= last]
    kept = list(backlog.since(0))
    assert [b for b in made(sizes) if b not in acknowledged] == [
        b for b in kept if b not in acknowledged
    ]
    if first == 0:  # as the server acknowledges what came in order
        assert not set(kept) & set(acknowledged)
    assert backlog.first_seq == (kept[0].seq_first if kept else backlog.next_seq)
    assert backlog.evicted_frames == 0


@given(batches)
def test_acknowledged_one_by_one_nothing_is_left(sizes: list[tuple[int, int]]) -> None:
    backlog = filled(sizes)
    for batch in made(sizes):
        assert backlog.first_seq == batch.seq_first
        backlog.acknowledge(batch.seq_first, batch.seq_last)
    assert numbers(backlog) == []
    assert backlog.first_seq == backlog.next_seq


@given(batches, st.integers(0, 29), st.integers(20, 200))
def test_what_was_acknowledged_makes_room(
    sizes: list[tuple[int, int]], acknowledged: int, bytes_max: int
) -> None:
    """Acknowledging right away, as on a good link, nothing is ever evicted."""
    backlog = Backlog(bytes_max)
    for n, batch in enumerate(made([(frames, min(size, 20)) for frames, size in sizes])):
        backlog.append(batch)
        if n <= acknowledged:
            backlog.acknowledge(0, batch.seq_last)
    later = sizes[acknowledged + 1 :]
    if sum(min(size, 20) for _, size in later) <= bytes_max:
        assert backlog.evicted_frames == 0
        assert len(numbers(backlog)) == sum(frames for frames, _ in later)


def test_frames_may_come_and_go_while_it_is_read() -> None:
    backlog = filled([(10, 5)] * 4)
    reading = backlog.since(10)
    assert next(reading).seq_first == 10
    backlog.acknowledge(0, 29)
    backlog.append(EncodedBatch(40, 49, b"x"))
    assert [b.seq_first for b in reading] == [20, 30]
    assert [b.seq_first for b in backlog.since(0)] == [30, 40]


def test_a_late_acknowledgement_of_what_was_evicted_takes_nothing_else() -> None:
    backlog = filled([(10, 100)] * 4, bytes_max=200)
    assert (backlog.first_seq, backlog.evicted_frames) == (20, 20)
    backlog.acknowledge(0, 9)
    backlog.acknowledge(0, 24)
    assert numbers(backlog) == list(range(20, 40))


# Several streams


@given(st.lists(batches, min_size=1, max_size=4), st.integers(0, 200))
def test_streams_together_keep_no_more_than_one_alone_and_the_oldest_frames_go(
    streams: list[list[tuple[int, int]]], bytes_max: int
) -> None:
    backlogs: list[Backlog] = []
    for sizes in streams:
        backlogs.append(Backlog(bytes_max))
        for batch in made(sizes):
            make_room(backlogs, batch, bytes_max)
            backlogs[-1].append(batch)
            held = sum(backlog.kept_bytes for backlog in backlogs)
            assert held <= bytes_max or held == len(batch.payload)  # the newest stays
    for sizes, backlog in zip(streams, backlogs, strict=True):
        frames = sum(count for count, _ in sizes)
        assert numbers(backlog) == list(range(backlog.first_seq, frames))
        assert backlog.evicted_frames == backlog.first_seq
    for older, newer in pairwise(backlogs):
        assert not (older.kept_bytes and newer.evicted_frames), "older frames go first"


def test_one_stream_alone_is_bounded_by_itself() -> None:
    backlog = filled([(10, 100)] * 4)
    make_room([backlog], EncodedBatch(40, 49, bytes(100)), 200)
    assert backlog.kept_bytes == 400

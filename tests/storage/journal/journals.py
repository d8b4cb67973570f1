"""Journals of one stream, and what they hold."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np

from devices.frames import FrameBatch
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.journal.segment_writer import SEGMENT_DURATION_NS
from storage.schema import wire_schema
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array
from tests.builders.frames import any_frames, assert_same_bits

TOP = 60


def stream(rows: int = TOP, tiles: int = 2, *, period_ns: int = PERIOD_NS) -> FrameBatch:
    """A stream from its first frame on, with any bits in columns without a law."""
    seq = np.arange(rows)
    t_mono_ns = period_ns * seq
    times = {"t_mono_ns": t_mono_ns, "t_ns": t_mono_ns + UTC_NS}
    return any_frames(rows, tiles, rows, seq=seq, **times)


ALL = stream()
SCHEMA = wire_schema(make_array())


def part(first: int, last: int) -> FrameBatch:
    """Frames `first` to `last`, both included, of the one stream that all tests take them from."""
    return ALL.slice_rows(first, last + 1)


def members(intervals: Intervals) -> set[int]:
    return {n for first, last in intervals for n in range(first, last + 1)}


def assert_holds(
    journal: Journal, numbers: set[int], first: int = 0, last: int = TOP, of: FrameBatch = ALL
) -> None:
    """Reading from `first` to `last` gives these frames of the stream, in order, each once."""
    assert members(journal.stored) == numbers
    expected = sorted(n for n in numbers if first <= n <= last)
    batches = list(journal.read_frames(first, last))
    assert all(len(batch) for batch in batches)
    read = [int(n) for batch in batches for n in batch.seq]
    assert read == expected
    if read:
        whole = FrameBatch.concatenate(batches)
        rows = {f.name: getattr(of, f.name)[expected] for f in fields(of)}
        assert_same_bits(whole, FrameBatch(**rows))


OPENED: list[Journal] = []


def begun(folder: Path) -> Journal:
    """A journal for this array; it is closed when the test ends."""
    OPENED.append(Journal(folder, make_array()))
    return OPENED[-1]


def reopened(folder: Path) -> Journal:
    """The journal as somebody finds it who knows its folder only."""
    OPENED.append(Journal.open_existing_and_recover(folder))
    return OPENED[-1]


def filled(folder: Path, *parts: tuple[int, int]) -> Journal:
    journal = begun(folder)
    for first, last in parts:
        journal.append_new_frames(part(first, last))
    return journal


def segments(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.arrows"))


LONG = stream(200, period_ns=SEGMENT_DURATION_NS // 20)
"""Ten minutes of frames, twenty a segment."""
HEADER = len(SCHEMA.serialize().to_pybytes())

"""Sync lines on a chip of files, with the library's own types. No test has touched a pin."""

from __future__ import annotations

import errno
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.acquisition import AcquiredFrame
from devices.errors import BusSetupError, MissingExtraError
from devices.frames import Edge
from devices.lamp_code import BIT_NS, LAMP_LATE_NS, is_lamp_on
from devices.scene.hardware_sections import SyncSection
from devices.sync_lines import EdgeReader, RecordingLine, SyncInput
from tests.devices.array.gpio_chip import EMULATED_GPIOD, FileChip

pytest.importorskip("gpiod", reason="sync lines need the extra `gpio`")


@pytest.fixture
def chip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FileChip:
    monkeypatch.delitem(sys.modules, "gpiod", raising=False)
    monkeypatch.syspath_prepend(EMULATED_GPIOD)
    return FileChip(tmp_path)


class Kept:
    """A sink that keeps what it is given, in order."""

    def __init__(self) -> None:
        self.given: list[Any] = []

    def write_edges(self, edges: Any) -> None:
        self.given += edges

    def write_frame(self, frame: Any) -> None:
        self.given.append(frame)


PERIOD_NS = 2_000_000
AT_ONCE = 64


class Line:
    """An input line, and the frames with which it is read."""

    def __init__(self, chip: FileChip, **keys: Any) -> None:
        scene = SyncSection(gpiochip=str(chip.path), input_line=17, **keys)
        self.input = SyncInput(scene, 17)
        self.seq, self.t_mono_ns = 0, 10**10
        self.begin_stream()

    def begin_stream(self) -> None:
        self.kept = Kept()
        self.reader = EdgeReader(self.input, self.kept)
        self.seq = 0
        self.take()

    def take(self, after_ns: int = PERIOD_NS) -> tuple[Edge, ...]:
        """Take a frame, and the edges up to it."""
        self.t_mono_ns += after_ns
        rest = (0, 0, 0, 0.0, 0, (), (), (), ())
        self.reader.write_frame(AcquiredFrame(self.seq, self.t_mono_ns, *rest))
        self.seq += 1
        return self.reader.take_batch()


@pytest.fixture
def line(chip: FileChip) -> Iterator[Line]:
    found = Line(chip, edge="both")
    yield found
    found.input.close()


def test_edges_come_with_their_stamps_before_the_frame_after_them(
    chip: FileChip, line: Line
) -> None:
    chip.send_edge(100)
    chip.send_edge(250, is_rising=False)
    assert line.take() == (Edge(1, 100, True), Edge(2, 250, False))
    assert line.take() == ()
    chip.send_edge(300)
    assert line.take() == (Edge(3, 300, True),)
    given = [each if isinstance(each, Edge) else each.seq for each in line.kept.given]
    assert given == [0, Edge(1, 100, True), Edge(2, 250, False), 1, 2, Edge(3, 300, True), 3]


def test_only_the_edges_that_the_scene_names_count(chip: FileChip) -> None:
    line = Line(chip, edge="falling")
    for t_ns in (1, 2, 3):
        chip.send_edge(t_ns, is_rising=t_ns != 2)
    assert line.take() == (Edge(1, 2, False),)
    line.input.close()


def test_a_storm_is_bounded_counted_and_said_until_it_is_over(chip: FileChip, line: Line) -> None:
    for t_ns in range(1000):
        chip.send_edge(t_ns)
    taken = line.take()
    assert [edge.number for edge in taken] == list(range(1001 - AT_ONCE, 1001)), "the newest"
    assert line.input.dropped_edges == 1000 - AT_ONCE
    assert "edges of the sync line are dropped" in line.input.warning
    chip.send_edge(2000)
    assert line.take() == (Edge(1001, 2000, True),)
    for _ in range(500):
        chip.send_edge(5)
        line.take()
    assert line.input.dropped_edges == 1000 - AT_ONCE
    assert line.input.warning == ""


def test_a_lasting_storm_keeps_2560_edges_a_second(chip: FileChip, line: Line) -> None:
    kept = 0
    for _ in range(500):
        for _ in range(20):
            chip.send_edge(5)
        kept += len(line.take())
    assert 2560 <= kept <= 2560 + AT_ONCE
    assert line.input.dropped_edges == 10_000 - kept


def test_a_backlog_of_a_stall_or_a_low_rate_is_kept(chip: FileChip, line: Line) -> None:
    for _ in range(500):
        chip.send_edge(5)
    assert len(line.take(after_ns=500_000_000)) == 500
    assert (line.input.dropped_edges, line.input.warning) == (0, "")


def test_edges_from_before_a_stream_are_not_in_it(chip: FileChip, line: Line) -> None:
    for number in range(1000):
        chip.send_edge(number, lost_before=number % 2)
    chip.send_edge(line.t_mono_ns + 2 * PERIOD_NS)
    line.begin_stream()
    assert [edge.number for edge in line.kept.given if isinstance(edge, Edge)] == [1501]
    assert (line.input.dropped_edges, line.input.warning) == (0, "")


def test_edges_that_the_kernel_dropped_are_counted(chip: FileChip, line: Line) -> None:
    chip.send_edge(1)
    chip.send_edge(2, lost_before=7)
    assert line.take() == (Edge(1, 1, True), Edge(9, 2, True))
    assert line.input.dropped_edges == 7


def test_a_line_that_goes_away_is_a_warning_and_frames_go_on(chip: FileChip, line: Line) -> None:
    chip.send_edge(1)
    (chip.path / "line17").unlink()
    assert line.take() == ()
    assert "the sync line fails, and edges are lost" in line.input.warning
    os.mkfifo(chip.path / "line17")
    assert line.take() == ()
    assert [frame.seq for frame in line.kept.given] == [0, 1, 2]


def test_the_number_goes_on_where_the_kernels_wraps(chip: FileChip, line: Line) -> None:
    for _ in range(2):
        chip.send_edge(1, lost_before=2**31)
    numbers = [edge.number for edge in line.take()]
    assert numbers == [2**31 + 1, 2**32 + 2]


@pytest.mark.parametrize("failure", [errno.ENOENT, errno.EACCES, errno.EBUSY])
def test_a_line_that_cannot_be_had_is_said_at_the_start(
    chip: FileChip, monkeypatch: pytest.MonkeyPatch, failure: int
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(failure, os.strerror(failure))

    monkeypatch.setattr("gpiod.request_lines", refuse)
    scene = SyncSection(gpiochip="/dev/gpiochip0", input_line=17, output_line=27)
    for begin in (lambda: SyncInput(scene, 17), lambda: RecordingLine(scene, 27)):
        with pytest.raises(BusSetupError, match=os.strerror(failure)) as caught:
            begin()
        assert caught.value.errno == failure
        assert "Check [sync]" in caught.value.remedy


def test_the_extra_is_named_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", None)
    with pytest.raises(MissingExtraError, match=r"'foottile\[gpio\]'"):
        SyncInput(SyncSection(input_line=17), 17)
    with pytest.raises(MissingExtraError, match=r"'foottile\[gpio\]'"):
        RecordingLine(SyncSection(output_line=17), 17)


def test_the_recording_line_is_low_at_first_and_in_the_end(chip: FileChip) -> None:
    line = RecordingLine(SyncSection(gpiochip=str(chip.path), output_line=27), 27)
    assert (chip.path / "line27").read_text() == "0"
    line.drive(high=True)
    assert chip.is_high(27)
    line.close()
    assert not chip.is_high(27)


def test_a_recording_line_that_fails_is_a_warning(
    chip: FileChip, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = RecordingLine(SyncSection(gpiochip=str(chip.path), output_line=27), 27)

    def refuse(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(line._request, "set_value", refuse)
    line.drive(high=True)
    assert "cannot be driven: Input/output error" in line.warning
    monkeypatch.undo()
    line.drive(high=True)
    assert line.warning == ""


def test_the_bound_contains_what_debouncing_delays() -> None:
    assert SyncSection(input_line=1).bound_ns == 200_000
    assert SyncSection(input_line=1, debounce_us=500).bound_ns == 10_700_000


class LateClock:
    """A clock whose sleeps begin on a sign, end late, and block after some of them."""

    def __init__(self, late_ns: list[int]) -> None:
        self.late_ns = late_ns
        self.edges_ns: list[int] = []
        self.may_begin, self.is_over = threading.Event(), threading.Event()
        self._t_ns = 10**13

    def now_ns(self) -> int:
        return self._t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        self.may_begin.wait(5.0)
        if len(self.edges_ns) == len(self.late_ns):
            self.is_over.set()
            threading.Event().wait(0.01)
            return
        self._t_ns = t_ns + self.late_ns[len(self.edges_ns)]
        self.edges_ns.append(t_ns)


@pytest.fixture
def lamp_scene(chip: FileChip) -> SyncSection:
    return SyncSection(gpiochip=str(chip.path), output_line=27, output="code")


def test_the_lamp_has_the_level_of_each_bit_from_its_edge_while_recording(
    chip: FileChip, lamp_scene: SyncSection, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = np.random.default_rng(4)
    clock = LateClock(generator.integers(0, LAMP_LATE_NS, 400).tolist())
    driven: list[tuple[int, bool]] = []

    def drive(line: RecordingLine, *, high: bool) -> None:
        driven.append((clock.now_ns(), high))

    monkeypatch.setattr(RecordingLine, "_set_level", drive)
    line = RecordingLine(lamp_scene, 27, clock)
    line.drive(high=True)
    clock.may_begin.set()
    assert clock.is_over.wait(5.0)
    assert line.warning == ""
    line.close()
    begun = next(row for row, (_, high) in enumerate(driven) if high)
    for (t_ns, high), edge_ns in zip(driven[begun:300], clock.edges_ns[begun:300], strict=True):
        assert edge_ns % BIT_NS == 0
        assert 0 <= t_ns - edge_ns <= LAMP_LATE_NS
        assert high == is_lamp_on(edge_ns)
    assert np.diff(clock.edges_ns).tolist() == [BIT_NS] * 399
    assert driven[-1][1] is False


def test_a_lamp_that_is_late_is_a_warning_until_it_is_not(
    chip: FileChip, lamp_scene: SyncSection
) -> None:
    for late_ns, is_warned in ((3 * LAMP_LATE_NS, True), (LAMP_LATE_NS // 2, False)):
        clock = LateClock([late_ns] * 70)
        line = RecordingLine(lamp_scene, 27, clock)
        line.drive(high=True)
        clock.may_begin.set()
        assert clock.is_over.wait(5.0)
        assert ("the lamp is switched late" in line.warning) == is_warned
        line.close()
        assert not chip.is_high(27)


@pytest.mark.real_time
def test_the_lamp_of_an_emulated_chip_follows_the_clock(
    chip: FileChip, lamp_scene: SyncSection
) -> None:
    line = RecordingLine(lamp_scene, 27)
    time.sleep(0.3)
    assert not any(high for _, high in chip.read_levels(27)), "dark before a recording"
    line.drive(high=True)
    begin_ns = time.monotonic_ns() + BIT_NS
    time.sleep(2.0)
    end_ns, warning = time.monotonic_ns(), line.warning
    line.drive(high=False)
    time.sleep(0.3)
    assert not chip.is_high(27)
    line.close()
    times_ns, levels = map(np.array, zip(*chip.read_levels(27), strict=True))
    late_ns = times_ns[1:-1] % BIT_NS
    assert late_ns.mean() <= LAMP_LATE_NS or "the lamp is switched late" in warning
    during = (times_ns > begin_ns) & (times_ns < end_ns)
    follows = levels[during] == [is_lamp_on(t_ns) for t_ns in times_ns[during].tolist()]
    assert follows.mean() >= 0.9
    assert len(follows) >= 15

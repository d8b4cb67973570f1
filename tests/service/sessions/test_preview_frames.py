"""Slices of a session that is not sealed have the bits of one estimate of all frames."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import service.sessions.preview
import service.sessions.preview_frames
import storage.journal.time_index
from devices.errors import StorageError, UsageError
from devices.frames import FrameBatch
from service.estimation.tare.tare import Tare
from service.sessions.inputs import SessionInputs, iterate_raw_frames_with_part
from service.sessions.preview import SessionPreview, SessionPreviews, make_preview_stream
from service.sessions.preview_frames import PreviewFrames
from storage.durable_files import ScratchFile
from storage.formats.export import Export, make_one_pass_frame_source
from storage.formats.slice import Slice
from storage.formats.writers.registry import FORMATS
from storage.journal.journal import Journal
from storage.sessions.folder import Part, Session
from storage.sessions.pyramid import (
    MAX_PREVIEW_BINS,
    BinBuilder,
    bin_source_columns,
    shift_bins_to_axis,
)
from tests.builders.arrays import PERIOD_NS
from tests.builders.frames import make_frames
from tests.service.sessions.pieces import array, calibration, hopping
from tests.service.sessions.test_estimate_stream_tares import taken_at

EVERY = 24


@pytest.fixture(scope="module", autouse=True)
def _small() -> Iterator[None]:
    """Places are near one another, and few of them are kept."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service.sessions.preview, "CHECKPOINT_FRAMES", EVERY)
        patch.setattr(service.sessions.preview, "CHECKPOINTS_MAX", 6)
        patch.setattr(service.sessions.preview, "_REST_FACTOR", 0)
        patch.setattr(service.sessions.preview, "UPDATE_BUDGET_S", 1e9)
        patch.setattr(storage.journal.time_index, "PIECE_FRAMES", 8)
        yield


class Recorded:
    """A session whose frames, parts and tares come one after the other."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.now = 0
        """Periods since it began; what is missing has passed, too."""
        self.journals: dict[str, Journal] = {}
        self.parts: list[Part] = []
        self.tares: list[Tare] = []
        self.late: list[tuple[Journal, FrameBatch]] = []
        self.rng = np.random.default_rng(1)
        self.begin_part(0)

    def begin_part(self, back: int) -> None:
        """The node is switched on again, its clocks set back by so many periods."""
        if self.parts:
            last = self.journals[self.parts[-1].stream_id].stored.last
            self.parts[-1] = self.parts[-1].model_copy(update={"seq_last": last or 0})
        self.stream_id, self.seq = f"{len(self.parts):032x}", 0
        self.now = max(0, self.now - back)
        info = array().model_copy(update={"stream_id": self.stream_id})
        self.journals[self.stream_id] = Journal(self.folder / self.stream_id, info)
        self.parts.append(Part(stream_id=self.stream_id, seq_first=0))

    def come(self, n: int, *, late: bool = False) -> None:
        """The next frames; `late`: they will be here after others."""
        seq = np.arange(self.seq, self.seq + n)
        force_n = hopping(n, loaded_from=self.seq % 7, seed=self.seq)
        t_ns = 10**18 + PERIOD_NS * (self.now + np.arange(n))
        frames = make_frames(
            seq, pressure_raw=500 - np.round(force_n), t_mono_ns=t_ns - 10**18, utc_offset_ns=10**18
        )
        self.seq, self.now = self.seq + n, self.now + n
        if late:
            self.late.append((self.journals[self.stream_id], frames))
        else:
            self.journals[self.stream_id].append_new_frames(frames)

    def sources(self) -> SessionInputs:
        return SessionInputs(
            session=Session(
                id="20200101T000000Z-00000a",
                name="",
                node="bench",
                state="recording",
                started_t_ns=0,
                parts=tuple(self.parts),
                scene="",
            ),
            info=array(),
            journals=self.journals,
            calibration=calibration(),
            problem=None,
            tares=tuple(self.tares),
            notes={},
        )

    def close(self) -> None:
        for journal in self.journals.values():
            journal.close()


def text_of(content: Any, part: Slice) -> bytes:
    return b"".join(FORMATS["csv"].encode(Export(content, array(), {}, part)))


def in_one_go(sources: SessionInputs, part: Slice) -> bytes:
    stream = make_preview_stream(sources)
    raw = iterate_raw_frames_with_part(sources)
    pieces = raw if stream is None else stream.estimate_batches(raw)
    return text_of(make_one_pass_frame_source(pieces, axis=sources.compute_time_axis()), part)


def so_it_is(so_far: SessionPreview, sources: SessionInputs, part: Slice) -> None:
    """A slice is that of one estimate of all there is; if one is refused, so is the other."""
    try:
        wanted = in_one_go(sources, part)
    except UsageError:
        with pytest.raises(UsageError):
            text_of(PreviewFrames(so_far, sources, part).make_one_pass_source(), part)
        return
    assert text_of(PreviewFrames(so_far, sources, part).make_one_pass_source(), part) == wanted


HAPPENS = st.one_of(
    st.tuples(st.just("come"), st.integers(1, 60)),
    st.tuples(st.just("come"), st.integers(1, 60)),
    st.tuples(st.just("come late"), st.integers(1, 20)),
    st.tuples(st.just("is here"), st.just(0)),
    st.tuples(st.just("look"), st.just(0)),
    st.tuples(st.just("look"), st.just(0)),
    st.tuples(st.just("tare"), st.integers(-20, 0)),
    st.tuples(st.just("switched on"), st.integers(0, 30)),
    st.tuples(st.just("slice"), st.integers(0, 300)),
)


@pytest.mark.slow(parts=8)
@settings(max_examples=30, deadline=None)
@given(happened=st.lists(HAPPENS, min_size=5, max_size=20), tared=st.booleans(), data=st.data())
def test_any_slice_at_any_moment_is_that_of_the_whole_in_one_go(
    happened: list[tuple[str, int]], tared: bool, data: st.DataObject
) -> None:
    folder = Path(tempfile.mkdtemp())
    recorded = Recorded(folder)
    recorded.come(3)
    if tared:
        recorded.tares.append(taken_at(0, 0.0))
    so_fars = SessionPreviews(folder)
    so_far = so_fars.advance_preview_within_time_limit(recorded.sources())
    try:
        for what, n in [*happened, ("look", 0), ("slice", 0), ("slice", 100)]:
            match what:
                case "come" | "come late":
                    recorded.come(n, late=what == "come late")
                case "is here" if recorded.late:
                    journal, frames = recorded.late.pop(0)
                    journal.append_new_frames(frames)
                case "look":
                    so_far = so_fars.advance_preview_within_time_limit(recorded.sources())
                case "tare":
                    at = max(
                        [PERIOD_NS * (recorded.now + n), *(t.t_ns - 10**18 for t in recorded.tares)]
                    )
                    recorded.tares.append(taken_at(at, float(len(recorded.tares))))
                case "switched on":
                    recorded.begin_part(n)
                case "slice":
                    length = data.draw(st.integers(1, 80))
                    part = Slice(start_s=0.002 * n, end_s=0.002 * (n + length))
                    so_it_is(so_far, recorded.sources(), part)
        so_it_is(so_far, recorded.sources(), Slice())
        assert_the_overview_is_as_in_one_go(
            so_fars.advance_preview_within_time_limit(recorded.sources()), recorded.sources()
        )
    finally:
        recorded.close()
        shutil.rmtree(folder)


def assert_the_overview_is_as_in_one_go(so_far: SessionPreview, sources: SessionInputs) -> None:
    stream = make_preview_stream(sources)
    raw = iterate_raw_frames_with_part(sources)
    wanted = BinBuilder(max_bins=MAX_PREVIEW_BINS)
    for frames, columns in raw if stream is None else stream.estimate_batches(raw, is_final=False):
        names = bin_source_columns(has_estimates=stream is not None)
        own = {name: getattr(frames, name) for name in names if name not in columns}
        wanted.add_frames(
            {**own, **{name: columns[name] for name in (*names, "part") if name in columns}}
        )
    bins = wanted.get_bins()
    if bins is None:
        return
    seen = so_far.get_bins(Slice(), 100_000).bins
    assert list(seen) == list(bins)
    for name, values in shift_bins_to_axis(bins, sources.compute_time_axis()).items():
        assert seen[name].tobytes() == values.tobytes(), name


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    """A session without a frame yet."""
    with closing(Recorded(tmp_path)) as begun:
        yield begun


@pytest.fixture
def long(recorded: Recorded) -> Recorded:
    """Twenty seconds with a tare."""
    recorded.tares.append(taken_at(0, 0.0))
    for _ in range(100):
        recorded.come(100)
    return recorded


def read_by(
    so_far: SessionPreview, recorded: Recorded, part: Slice, monkeypatch: pytest.MonkeyPatch
) -> int:
    """Frames that were read from the journals for a slice."""
    read = 0

    def counted(*arguments: Any) -> Iterator[Any]:
        nonlocal read
        for frames, columns in iterate_raw_frames_with_part(*arguments):
            read += len(frames)
            yield frames, columns

    monkeypatch.setattr(service.sessions.preview_frames, "iterate_raw_frames_with_part", counted)
    text_of(PreviewFrames(so_far, recorded.sources(), part).make_one_pass_source(), part)
    return read


def test_the_cost_of_a_slice_does_not_depend_on_its_place(
    long: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    so_far = SessionPreviews(tmp_path).advance_preview_within_time_limit(long.sources())
    apart = so_far.checkpoints.distance_frames
    assert len(so_far.checkpoints.checkpoints) <= 6
    assert 1000 <= apart < 4000
    for begin_s in (0.0, 5.0, 12.34, 19.8):
        part = Slice(begin_s, begin_s + 0.1)
        read = read_by(so_far, long, part, monkeypatch)
        assert 50 <= read < apart + 1200, begin_s  # the estimate goes on by a thousand


def test_late_frames_have_only_the_frames_behind_them_estimated_anew(
    recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.sessions.preview, "CHECKPOINTS_MAX", 1000)
    recorded.tares.append(taken_at(0, 0.0))
    so_fars = SessionPreviews(tmp_path)
    recorded.come(4000)
    recorded.come(100, late=True)
    recorded.come(900)
    so_far = so_fars.advance_preview_within_time_limit(recorded.sources())
    before = so_far.checkpoints.checkpoints
    journal, frames = recorded.late.pop()
    journal.append_new_frames(frames)
    true = so_far.valid_checkpoints(recorded.sources())
    assert 4000 - 2 * EVERY < true[-1].fed_frames <= 4000
    assert list(true) == list(before[: len(true)])
    assert so_fars.advance_preview_within_time_limit(recorded.sources()) is so_far
    assert so_far.checkpoints.checkpoints[: len(true) - 2] == before[: len(true) - 2]
    assert_the_overview_is_as_in_one_go(so_far, recorded.sources())
    so_it_is(so_far, recorded.sources(), Slice(8.1, 8.3))


@pytest.mark.parametrize("failing", ["put", "get"])
def test_a_disk_that_is_full_or_forgets_costs_time_and_no_frame(
    long: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    def refuse(*_: object) -> None:
        raise StorageError("the disk is full")

    so_fars = SessionPreviews(tmp_path)
    if failing == "put":
        monkeypatch.setattr(ScratchFile, "append", refuse)
    so_far = so_fars.advance_preview_within_time_limit(long.sources())
    assert (len(so_far.checkpoints.checkpoints) == 1) == (failing == "put")
    if failing == "get":
        monkeypatch.setattr(ScratchFile, "read", refuse)
    so_it_is(so_far, long.sources(), Slice(15.0, 15.1))


def test_a_preview_has_raw_frames_until_there_is_a_tare(recorded: Recorded, tmp_path: Path) -> None:
    so_fars = SessionPreviews(tmp_path)
    recorded.come(300)
    raw = so_fars.advance_preview_within_time_limit(recorded.sources())
    so_it_is(raw, recorded.sources(), Slice(0.3, 0.4))
    assert not raw.has_estimate_stream
    recorded.tares.append(taken_at(2_000_000 * 200, 0.0))
    so_it_is(raw, recorded.sources(), Slice(0.3, 0.4))
    estimated = so_fars.advance_preview_within_time_limit(recorded.sources())
    assert estimated.has_estimate_stream
    so_it_is(estimated, recorded.sources(), Slice(0.3, 0.4))


@pytest.mark.parametrize("looked", [100, 200, 260, 300])
def test_a_clock_that_was_set_back_has_its_parts_one_behind_the_other(
    recorded: Recorded, tmp_path: Path, looked: int
) -> None:
    so_fars = SessionPreviews(tmp_path)
    recorded.tares.append(taken_at(0, 0.0))
    so_far = SessionPreview(recorded.sources(), tmp_path)
    for come in range(300):
        if come == 200:
            recorded.begin_part(150)
        recorded.come(1)
        if come == looked - 1:
            so_far = so_fars.advance_preview_within_time_limit(recorded.sources())
    for begin_s, number in ((0.2, 0), (0.42, 1)):
        part = Slice(begin_s, begin_s + 0.02, ("part",))
        so_it_is(so_far, recorded.sources(), part)
        assert in_one_go(recorded.sources(), part).split()[1:] == [b"%d" % number] * 10
    so_it_is(so_far, recorded.sources(), Slice(0.39, 0.41))


def test_a_preview_before_the_first_frame_is_refused(recorded: Recorded, tmp_path: Path) -> None:
    sources = recorded.sources()
    with pytest.raises(UsageError, match="no frames"):
        PreviewFrames(SessionPreview(sources, tmp_path), sources, Slice()).make_one_pass_source()

"""A slice of a sealed file is that of the whole table, and reads no more than it needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError, FootTileError, UsageError
from devices.frames import FrameBatch
from storage.clock.log import ClockOffset
from storage.clock.table import StreamClockFacts, write_clock_file
from storage.formats.export import ClockName, make_one_pass_frame_source, make_sealed_export
from storage.formats.markers import PLACEMENT_COLUMNS, place_markers, place_session_markers
from storage.formats.slice import Slice
from storage.formats.writers.tables import ARROW
from storage.schema import Array
from storage.sessions import writer
from storage.sessions.folder import Marker
from storage.sessions.metadata import load_clock_table
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter, parquet_options
from tests.builders.arrays import make_array
from tests.builders.frames import make_frames
from tests.storage.formats.exports import NO_TIMES, export

SECOND_NS = 1_000_000_000
PERIOD_NS = SECOND_NS // 10
UTC_NS = 10**18
COLUMNS = (
    *("seq", "t_ns", "t_mono_ns", "part", "pressure_raw", "pressure_raw_1"),
    *("grf_n", "force_n_0", "phase"),
)


@dataclass(frozen=True)
class Boot:
    """A part: how many frames, when its clocks began, and where it lacks some."""

    rows: int
    t_mono_ns: int
    utc_ns: int
    gap_at: int
    gap: int


boots = st.builds(
    Boot,
    rows=st.integers(1, 60),
    t_mono_ns=st.integers(0, 20 * SECOND_NS),
    utc_ns=st.integers(-10 * SECOND_NS, 30 * SECOND_NS).map(lambda ns: UTC_NS + ns),
    gap_at=st.integers(0, 60),
    gap=st.sampled_from([0, 1, 80]),
)
seconds = st.none() | st.floats(0.0, 30.0) | st.integers(0, 120).map(lambda tenths: tenths / 10)
columns = st.lists(st.sampled_from(COLUMNS), max_size=3).map(tuple)


def recorded(parts: Sequence[Boot]) -> tuple[FrameBatch, dict[str, Array]]:
    """Frames of these parts; a clock may have been set back in between."""
    rng = np.random.default_rng(1)
    pieces = []
    for part in parts:
        seq = np.arange(part.rows) + part.gap * (np.arange(part.rows) >= part.gap_at)
        t_mono_ns = part.t_mono_ns + PERIOD_NS * seq + rng.integers(0, PERIOD_NS // 2, part.rows)
        pressure_raw = rng.integers(250, 420, (part.rows, 2))
        pieces.append(
            make_frames(
                seq, 2, t_mono_ns=t_mono_ns, utc_offset_ns=part.utc_ns, pressure_raw=pressure_raw
            )
        )
    frames = FrameBatch.concatenate(pieces)
    force_n = rng.normal(0.0, 20.0, (len(frames), 2))
    force_n[rng.random(force_n.shape) < 0.2] = np.nan
    return frames, {
        "part": np.repeat(np.arange(len(parts), dtype=np.uint16), [part.rows for part in parts]),
        "force_n": force_n,
        "grf_n": force_n.sum(axis=1),
        "phase": np.where(rng.random(len(frames)) < 0.5, "rest", "load").astype(object),
    }


def sealed(
    path: Path, frames: FrameBatch, extra: dict[str, Array], group_ns: int, **options: Any
) -> Path:
    """The file, with row groups of so long."""
    info = make_array(2, stream_id="boot 0", utc_offset_ns=UTC_NS, clock_set=True)
    parts = [{"stream_id": f"boot {i}"} for i in range(int(extra["part"].max()) + 1)]

    def changed(schema: pa.Schema) -> dict[str, Any]:
        return parquet_options(schema) | options

    with (
        patch.object(writer, "MIN_ROW_GROUP_NS", group_ns),
        patch.object(writer, "parquet_options", changed),
        SealedFileWriter(path, info, {"session": {"id": "s", "parts": parts}}) as file,
    ):
        file.append_frames(frames, extra)
    return path


def outcome(chunks: Callable[[], Any]) -> pa.Table | str:
    try:
        return pa.ipc.open_file(b"".join(chunks())).read_all().combine_chunks()
    except UsageError as error:
        return str(error)


def sliced(path: Path, part: Slice, clock: ClockName, events: Sequence[Marker]) -> pa.Table | str:
    with SealedFileReader(path, only_slices=True) as reader:
        markers = place_session_markers(reader, events, part) if events else None
        wanted = make_sealed_export(reader, part, clock=clock, markers=markers, options=NO_TIMES)
        return outcome(lambda: ARROW.encode(wanted))


def of_the_whole(
    path: Path,
    frames: FrameBatch,
    extra: dict[str, Array],
    part: Slice,
    clock: ClockName,
    events: Sequence[Marker],
) -> pa.Table | str:
    with SealedFileReader(path) as reader:
        table = load_clock_table(reader)
        times = {name: getattr(frames, name) for name in PLACEMENT_COLUMNS} | {
            "part": extra["part"]
        }
        axis = reader.time_axis
        markers = place_markers(events, [times], table, part, axis=axis) if events else None
        return outcome(
            lambda: export(
                make_one_pass_frame_source([(frames, extra)], axis=axis),
                reader.info,
                reader.notes,
                "arrow",
                part,
                table if clock == "server" else None,
                markers,
                reader.session_id_and_hashes,
            )
        )


def same(a: pa.Table | str, b: pa.Table | str) -> bool:
    if isinstance(a, str) or isinstance(b, str):
        return a == b
    return bool(a.equals(b, check_metadata=True))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sliced")


@pytest.mark.slow
@settings(max_examples=40)
@given(
    parts=st.lists(boots, min_size=1, max_size=3),
    group_ns=st.sampled_from([PERIOD_NS, 7 * PERIOD_NS, SECOND_NS, 60 * SECOND_NS]),
    start_s=seconds,
    length_s=seconds,
    asked=columns,
    clock=st.sampled_from(["node", "server"]),
    marks_s=st.lists(st.floats(-15.0, 45.0), max_size=3),
    steps=st.lists(st.sampled_from([0, 0, 1, 3 * SECOND_NS]), max_size=5),
    options=st.sampled_from([{}, {}, {"write_statistics": False}]),
)
def test_a_slice_by_statistics_is_that_of_the_whole_table(
    folder: Path,
    parts: list[Boot],
    group_ns: int,
    start_s: float | None,
    length_s: float | None,
    asked: tuple[str, ...],
    clock: ClockName,
    marks_s: list[float],
    steps: list[int],
    options: dict[str, Any],
) -> None:
    end_s = None if length_s is None else (start_s or 0.0) + max(length_s, 1e-6)
    part = Slice(start_s, end_s, asked)
    frames, extra = recorded(parts)
    path = sealed(folder / "s.parquet", frames, extra, group_ns, **options)
    events = [
        Marker(id=f"{i:012x}", label=f"marker {i}", t_ns=UTC_NS + round(at_s * 1e9))
        for i, at_s in enumerate(marks_s)
    ]
    rows = [  # of the first part's clock, which may step; of the others nothing is known
        ClockOffset(
            stream_id="boot 0",
            t_mono_ns=i * 5 * SECOND_NS,
            server_minus_node_ns=step,
            uncertainty_ns=1000,
        )
        for i, step in enumerate(steps)
    ]
    write_clock_file(folder / "clock.parquet", rows, [StreamClockFacts("boot 0", UTC_NS, True)])
    found = sliced(path, part, clock, events)
    assert same(found, of_the_whole(path, frames, extra, part, clock, events)), found


def test_why_a_mark_is_at_no_frame_is_found_in_the_whole_file(tmp_path: Path) -> None:
    """Two streams that no clock was compared with share a row group: it may hold the marker."""
    parts = [Boot(6, at_s * SECOND_NS, UTC_NS, 0, 0) for at_s in (0, 100, 110)]
    frames, extra = recorded(parts)
    path = sealed(tmp_path / "s.parquet", frames, extra, 60 * SECOND_NS)
    offset = {"t_mono_ns": 0, "server_minus_node_ns": 0, "uncertainty_ns": 1000}
    rows = [ClockOffset.model_validate({"stream_id": "boot 0", **offset})]
    write_clock_file(tmp_path / "clock.parquet", rows, [StreamClockFacts("boot 0", UTC_NS, True)])
    events = [Marker(id=f"{0:012x}", label="far", t_ns=UTC_NS + 1000 * SECOND_NS)]
    found = sliced(path, Slice(), "node", events)
    assert same(found, of_the_whole(path, frames, extra, Slice(), "node", events)), found
    with SealedFileReader(path) as reader:
        (marker,) = place_session_markers(reader, events, Slice()).markers
    assert marker.exclusion_reason == "no frame within a second of it"


# --- what is read ---------------------------------------------------------------------------------


LONG = Boot(rows=100, t_mono_ns=5, utc_ns=UTC_NS, gap_at=0, gap=0)


def ten_groups(path: Path) -> Path:
    return sealed(path, *recorded([LONG]), SECOND_NS)


def place_of(path: Path, group: int, name: str) -> tuple[int, int]:
    """Where a column's pages are in the file, first byte and the one behind."""
    with pq.ParquetFile(path) as whole:
        at = whole.schema_arrow.get_field_index(name)
        column = whole.metadata.row_group(group).column(at)
        begin = column.dictionary_page_offset or column.data_page_offset
        return begin, begin + column.total_compressed_size


def table_of(path: Path, part: Slice) -> pa.Table:
    with SealedFileReader(path, only_slices=True) as reader:
        content = b"".join(ARROW.encode(make_sealed_export(reader, part, options=NO_TIMES)))
    return pa.ipc.open_file(content).read_all()


def test_a_slice_reads_no_page_but_its_own(tmp_path: Path) -> None:
    path = ten_groups(tmp_path / "s.parquet")
    part = Slice(4.2, 5.1, ("force_n_1",))
    right = table_of(path, part)
    content = bytearray(path.read_bytes())
    kept = [(0, "t_ns"), *((group, name) for group in (4, 5) for name in ("t_ns", "force_n_1"))]
    places = [place_of(path, group, name) for group, name in kept]
    with pq.ParquetFile(path) as whole:
        names, groups = whole.schema_arrow.names, whole.num_row_groups
    for group in range(groups):
        for name in names:
            begin, end = place_of(path, group, name)
            if (begin, end) not in places:
                content[begin:end] = bytes(end - begin)  # whoever reads it fails
    path.write_bytes(content)
    assert table_of(path, part).equals(right)
    with pytest.raises(FileFormatError, match="row group 6 cannot be read"):
        table_of(path, Slice(4.2, 6.5, ("force_n_1",)))
    with pytest.raises(FileFormatError, match="changed since it was sealed"):
        SealedFileReader(path)


# --- damage ---------------------------------------------------------------------------------------


def refused_or(path: Path, part: Slice, right: pa.Table) -> str:
    try:
        return "right" if table_of(path, part).equals(right) else "wrong"
    except FootTileError:
        return "refused"


@pytest.mark.parametrize("every_bit", [False, pytest.param(True, marks=pytest.mark.soak)])
@pytest.mark.parametrize("name", ["force_n_1", "phase"])
def test_a_slice_of_a_file_with_a_flipped_bit_is_refused_or_right(
    tmp_path: Path, name: str, every_bit: bool
) -> None:
    path, part = ten_groups(tmp_path / "s.parquet"), Slice(4.2, 5.1, (name,))
    right, whole = table_of(path, part), path.read_bytes()
    begins = [place_of(path, 4, column)[0] for column in ("t_ns", name)]
    headers = [at for begin in begins for at in range(begin, begin + 48)]
    flips = [(at, at % 8) for at in (*range(0, len(whole), 211), *headers)]
    if every_bit:
        flips = [(at, bit) for at in (*range(len(whole)), *headers) for bit in range(8)]
    found = {}
    for at, bit in flips:
        content = bytearray(whole)
        content[at] ^= 1 << bit
        path.write_bytes(content)
        found[at, bit] = refused_or(path, part, right)
    wrong = [place for place, what in found.items() if what == "wrong"]
    assert (wrong, set(found.values())) == ([], {"refused", "right"})


def test_a_page_of_another_kind_is_not_left_out(tmp_path: Path) -> None:
    """Arrow skips what it does not know: a slice would begin at another instant."""
    t_mono_ns = np.arange(30_000) * 1_000_000
    frames = make_frames(30_000, 2, t_mono_ns=t_mono_ns)
    extra = {"part": np.zeros(30_000, np.uint16)}
    path = sealed(tmp_path / "s.parquet", frames, extra, 60 * SECOND_NS)
    part = Slice(1.0, 2.0, ("seq",))
    right, whole = table_of(path, part), path.read_bytes()
    assert len(right) == 1000
    kind_at = place_of(path, 0, "t_ns")[0] + 1
    assert whole[kind_at] == 0  # a data page
    for bit in range(8):
        content = bytearray(whole)
        content[kind_at] ^= 1 << bit
        path.write_bytes(content)
        assert refused_or(path, part, right) == "refused"
        with SealedFileReader(path, only_slices=True) as reader, pytest.raises(FileFormatError):
            reader.read_span_on_axis_ns()

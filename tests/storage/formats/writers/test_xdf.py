"""XDF files, read by pyxdf."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import pyxdf

from devices.arrays import Bools
from devices.frames import NO_SERVO_COUNTS, NOT_READ
from storage.clock.bounds import OffsetRows
from storage.clock.table import ClockTable, StreamClockFacts
from storage.formats.export import make_one_pass_frame_source
from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from storage.schema import Array
from tests.builders.arrays import PERIOD_NS, make_array
from tests.storage.formats.exports import NOTES, ROWS, cut, export, extra, frames
from tests.storage.formats.writers.test_mcap import LABEL, markers

STREAM_IDS = ["0" * 32, "1" * 32]


def written(
    part: Slice | None = None,
    columns: Mapping[str, Array] | None = None,
    clock: ClockTable | None = None,
    *,
    every: int = 20,
    options: FormatOptions = NO_OPTIONS,
    taken: Bools | None = None,
) -> bytes:
    rows = np.flatnonzero(np.full(ROWS, True) if taken is None else taken)
    of_rows = {name: v[rows] for name, v in (extra() if columns is None else columns).items()}
    content = make_one_pass_frame_source(cut(frames().select_rows(rows), of_rows, every))
    source = {"session": "s <&> 🦶"}
    info, facts = make_array(node="left"), (clock, markers(), source, options)
    return b"".join(export(content, info, NOTES, "xdf", part or Slice(), *facts))


def read(content: bytes, **options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Streams by name, and the header; nothing is done to instants unless it is asked for."""
    plain = {"synchronize_clocks": False, "dejitter_timestamps": False}
    streams, header = pyxdf.load_xdf(io.BytesIO(content), **(plain | options))
    return {stream["info"]["name"][0]: stream for stream in streams}, header["info"]


def labels(stream: Any) -> list[str]:
    return [channel["label"][0] for channel in stream["info"]["desc"][0]["channels"][0]["channel"]]


def series(stream: Any, name: str) -> Array:
    found: Array = stream["time_series"][:, labels(stream).index(name)]
    return found


def ahead_by_90_s(end_ns: int, *streams: str) -> ClockTable:
    """The server is ahead of the first stream's clock; of the others nothing was measured."""
    ahead = OffsetRows(np.array([0, end_ns]), np.array([90 * 10**9] * 2), np.array([100] * 2))
    facts = [StreamClockFacts(stream, 10**18, True) for stream in streams]
    return ClockTable({streams[0]: ahead}, facts, list(streams))


@pytest.mark.parametrize("every", [1, 20, ROWS])
def test_each_frame_is_a_sample_at_its_time(every: int) -> None:
    batch, columns = frames(), extra()
    streams, _ = read(written(every=every))
    assert set(streams) == {"left frames", "left counters", "left markers"}
    of_frames, counters = streams["left frames"], streams["left counters"]
    for stream in (of_frames, counters):
        at_ns = (stream["time_stamps"] * 1e9).astype(np.int64)
        assert np.abs(at_ns - batch.t_ns).max() < 300  # a float of seconds since 1970
    for i in range(2):
        force_n = columns["force_n"][:, i].astype(np.float32)
        np.testing.assert_array_equal(series(of_frames, f"force_n_{i}"), force_n)
        pressure_raw = np.where(
            batch.pressure_raw[:, i] == NOT_READ, np.nan, batch.pressure_raw[:, i]
        )
        np.testing.assert_array_equal(series(of_frames, f"pressure_raw_{i}"), pressure_raw)
    servo = np.where(batch.servo_counts == NO_SERVO_COUNTS, np.nan, batch.servo_counts)
    np.testing.assert_array_equal(series(counters, "servo_counts"), servo)
    np.testing.assert_array_equal(series(counters, "seq"), batch.seq.astype(np.float64))


def test_channels_have_units_and_serials_and_footers_count_the_samples() -> None:
    stream = read(written())[0]["left frames"]
    channels = stream["info"]["desc"][0]["channels"][0]["channel"]
    said = {channel["label"][0]: channel for channel in channels}
    assert said["force_n_1"]["unit"] == ["N"]
    assert said["force_n_1"]["serial"] == [make_array().tiles[1].serial]
    footer = stream["footer"]["info"]
    assert footer["sample_count"] == [str(ROWS)]
    assert float(footer["last_timestamp"][0]) == stream["time_stamps"][-1]


def test_a_mark_is_a_sample_of_text_at_its_frame() -> None:
    stream = read(written())[0]["left markers"]
    assert stream["time_series"] == [[LABEL]]
    assert abs(stream["time_stamps"][0] - frames().t_ns[12] * 1e-9) < 1e-6
    assert stream["info"]["type"] == ["Markers"]


def test_clock_offsets_lead_each_part_to_the_servers_time() -> None:
    """The server is 90 s ahead of the first part's clock; of the second nothing was measured."""
    columns = extra()
    columns["part"][30:] = 1
    clock = ahead_by_90_s(60_000_000, *STREAM_IDS)
    raw, _ = read(written(columns=columns, clock=clock))
    set_, _ = read(written(columns=columns, clock=clock), synchronize_clocks=True)
    assert len(raw["left frames"]["clock_times"]) == 1
    first = set_["left frames"]["time_stamps"] - raw["left frames"]["time_stamps"]
    np.testing.assert_allclose(first, 90.0, atol=1e-5)
    assert len(first) == 30
    second = "left frames part 1"
    assert not raw[second]["clock_times"]
    np.testing.assert_array_equal(set_[second]["time_stamps"], raw[second]["time_stamps"])
    assert len(raw[second]["time_stamps"]) == ROWS - 30


def test_a_pause_of_years_adds_one_clock_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("storage.formats.writers.xdf._OFFSET_EVERY_NS", 20_000_000)
    batch = frames()
    late = batch.select_rows(np.arange(len(batch)))
    late.t_ns[30:] += 10**17
    late.t_mono_ns[30:] += 10**17
    clock = ahead_by_90_s(2 * 10**17, *STREAM_IDS)
    found = {}
    for each in (batch, late):
        content = make_one_pass_frame_source(cut(each, extra(), ROWS))
        chunks = export(
            content, make_array(node="left"), NOTES, "xdf", Slice(), clock, options=NO_OPTIONS
        )
        streams, _ = read(b"".join(chunks))
        found[each is late] = len(streams["left frames"]["clock_times"])
    assert found[False] <= found[True] <= found[False] + 1


@pytest.mark.parametrize("odd", ["\ufffe", "\uffff", "\x08"])
def test_what_xml_cannot_hold_is_escaped(odd: str) -> None:
    info = make_array()
    tiles = tuple(tile.model_copy(update={"serial": f"T{odd}1"}) for tile in info.tiles)
    info = info.model_copy(update={"tiles": tiles})
    content = make_one_pass_frame_source(cut(frames(), extra(), 20))
    found = b"".join(
        export(content, info, NOTES, "xdf", Slice(), None, None, {"session": odd}, NO_OPTIONS)
    )
    streams, header = read(found)
    shown = odd.encode("unicode_escape").decode()
    assert header["session"] == [shown]
    assert repr(f"T{shown}1")[1:-1] in str(streams)


@pytest.mark.parametrize("every", [7, ROWS])
def test_at_a_constant_rate_samples_of_lost_frames_are_empty(every: int) -> None:
    columns = extra()
    columns["part"][30:] = 1
    taken = (np.arange(ROWS) < 15) | (np.arange(ROWS) >= 22)
    content = written(
        columns=columns, every=every, taken=taken, options=FormatOptions(rate="constant")
    )
    streams, _ = read(content)
    assert set(streams) == {"left frames", "left counters", "left markers"}
    stream = streams["left frames"]
    rate_hz = float(stream["info"]["nominal_srate"][0])
    assert rate_hz == pytest.approx(1e9 / PERIOD_NS)
    assert len(stream["time_stamps"]) == ROWS
    np.testing.assert_allclose(np.diff(stream["time_stamps"]), 1.0 / rate_hz, atol=5e-7)
    force_n = np.where(taken, columns["force_n"][:, 0], np.nan).astype(np.float32)
    np.testing.assert_array_equal(series(stream, "force_n_0"), force_n)
    assert streams["left markers"]["time_series"] == [[LABEL]]


def test_a_constant_rate_keeps_the_clock_offset() -> None:
    clock = ahead_by_90_s(60_000_000, STREAM_IDS[0])
    content = written(clock=clock, options=FormatOptions(rate="constant"))
    raw, set_ = read(content)[0], read(content, synchronize_clocks=True)[0]
    ahead_s = set_["left frames"]["time_stamps"] - raw["left frames"]["time_stamps"]
    np.testing.assert_allclose(ahead_s, 90.0, atol=1e-5)

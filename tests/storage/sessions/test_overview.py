"""`overview.arrow`: what was written is read piece by piece, and proven; damage is damage."""

from __future__ import annotations

import io
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import storage.sessions.overview
from devices.errors import DamagedFileError
from storage.durable_files import open_regular_file
from storage.sessions.overview import OverviewReader, encode_overview, open_overview, write_overview
from storage.sessions.pyramid import Bins
from tests.storage.sessions.test_pyramid import TILES, frames, gathered, same

HASH = "0123456789abcdef" * 4


def content(n: int, parts: tuple[int, ...] = ()) -> tuple[list[Bins], pa.Buffer]:
    levels = gathered(frames(n, parts=parts)).pop_levels()
    return levels, encode_overview(levels, tile_count=TILES, frames_sha256=HASH)


def test_every_level_is_read_as_it_was_written(tmp_path: Path) -> None:
    levels, written = content(100_000)
    write_overview(tmp_path / "overview.arrow", levels, tile_count=TILES, frames_sha256=HASH)
    assert (tmp_path / "overview.arrow").read_bytes() == written.to_pybytes()
    with open_overview(tmp_path / "overview.arrow") as overview:
        assert overview.index.frames_sha256 == HASH
        assert overview.index.level_count == len(levels) == 2
        assert overview.index.begin_ns == levels[0]["t_first_ns"][0]
        for number, level in enumerate(levels):
            found = overview.read_bins(number, None, None)
            same({name: level[name].astype(found[name].dtype) for name in found}, found)
            assert overview.estimate_bin_count(number, None, None) == len(level["part"])


def test_arrow_reads_without_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # It would abort a process that ends meanwhile.
    levels, _ = content(1000)
    write_overview(tmp_path / "overview.arrow", levels, tile_count=TILES, frames_sha256=HASH)
    opened: list[io.BufferedReader] = []

    def kept(path: Path) -> io.BufferedReader:
        opened.append(open_regular_file(path))
        return opened[-1]

    monkeypatch.setattr(storage.sessions.overview, "open_regular_file", kept)
    with open_overview(tmp_path / "overview.arrow") as overview:
        assert [file.closed for file in opened] == [True]
        assert len(overview.read_bins(0, None, None)["part"]) == len(levels[0]["part"])


def test_some_time_is_all_bins_that_have_a_frame_in_it(tmp_path: Path) -> None:
    levels, written = content(600_000)
    with OverviewReader(pa.BufferReader(written), where="here") as overview:
        finest = levels[0]
        begin_ns, end_ns = int(finest["t_last_ns"][5000]), int(finest["t_first_ns"][6000])
        found = overview.read_bins(0, begin_ns, end_ns)
        assert found["t_first_ns"][0] == finest["t_first_ns"][5000]
        assert found["t_last_ns"][-1] == finest["t_last_ns"][5999]
        assert (
            overview.estimate_bin_count(0, begin_ns, end_ns) == 4096
        )  # of three pieces one is looked at
        nothing = overview.read_bins(0, end_ns + 10**15, None)
        assert len(nothing["part"]) == 0
        assert nothing.keys() == found.keys()


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 10**7), bit=st.integers(0, 7))
def test_any_flipped_bit_is_damage_or_changes_nothing(tmp_path: Path, at: int, bit: int) -> None:
    levels, written = content(3000)
    changed = bytearray(written)
    changed[at % len(changed)] ^= 1 << bit
    (tmp_path / "overview.arrow").write_bytes(changed)
    try:
        with open_overview(tmp_path / "overview.arrow") as overview:
            assert overview.index.frames_sha256 == HASH
            found = overview.read_bins(0, None, None)
    except DamagedFileError:
        return
    same({name: levels[0][name].astype(found[name].dtype) for name in found}, found)


@given(length=st.integers(0, 10**7))
def test_a_file_that_ends_too_early_is_damage(length: int) -> None:
    _, written = content(300)
    some = written.slice(0, length % len(written))
    with pytest.raises(DamagedFileError, match="Delete it"):
        OverviewReader(pa.BufferReader(some), where="here")


def test_another_file_is_refused_and_none_is_none(tmp_path: Path) -> None:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, pa.schema([("part", pa.int64())])):
        pass
    with pytest.raises(DamagedFileError, match="is no overview"):
        OverviewReader(pa.BufferReader(sink.getvalue()), where="here")
    with pytest.raises(FileNotFoundError):
        open_overview(tmp_path / "overview.arrow")

"""A sealed session in its folder, compared: its markers are trials, its own clock is taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError
from service.offline.compare.report import format_comparison_report
from service.offline.comparison import CompareOptions, compare_session
from storage.clock.log import ClockOffset
from storage.clock.table import write_clock_file
from storage.formats.reference import ReferenceOptions
from storage.sessions.folder import Marker, Part, Session
from storage.sessions.metadata import write_markers
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import make_array
from tests.builders.frames import make_frames
from tests.service.offline.compare.gaits import Gait

PERIOD_NS = 2_000_000
SECONDS = 20.0
OWN = CompareOptions(ReferenceOptions())


def seal(
    folder: Path,
    *,
    stream_id: str = "one",
    later_s: float = 0.0,
    bias_n: float = 0.0,
    server_minus_node_s: float = 0.0,
) -> Path:
    """A session of an irregular gait, `later_s` behind another's clock."""
    n = round(SECONDS * 1e9 / PERIOD_NS)
    info = make_array(2, stream_id=stream_id)
    frames = make_frames(n, 2, period_ns=PERIOD_NS)
    gait = Gait(np.random.default_rng(0), SECONDS)
    true_n = gait.at(np.linspace(0.0, SECONDS, n, endpoint=False) - later_s)
    loaded = true_n > 0.5
    grf_n = true_n + bias_n * loaded + 0.05 * np.random.default_rng(1).normal(size=n)
    cop = {f"cop_{name}_m": np.where(loaded, 0.0, np.nan) for name in ("x", "y")}
    sigmas = {f"cop_sigma_{name}_m": np.full(n, 0.001) for name in ("x", "y")}
    columns = {
        "force_n": np.stack([grf_n, grf_n], axis=1) / 2.0,
        "grf_n": grf_n,
        "grf_sigma_n": np.full(n, 0.05),
        "contact": loaded.astype(np.uint8),
        "estimate_flags": np.zeros(n, dtype=np.uint16),
        **cop,
        **sigmas,
    }
    folder.mkdir()
    path = folder / "frames.parquet"
    with SealedFileWriter(path, info, {}) as writer:
        writer.append_frames(frames, columns)
    clock = [
        ClockOffset(
            stream_id=stream_id,
            t_mono_ns=t_ns,
            server_minus_node_ns=round(server_minus_node_s * 1e9),
            uncertainty_ns=500_000,
        )
        for t_ns in range(0, round(SECONDS * 1e9), 10 * 10**9)
    ]
    write_clock_file(folder / "clock.parquet", clock, [])
    return path


def marker(folder: Path, **labels: float) -> None:
    """Write markers at these seconds."""
    begin_ns = int(make_frames(1, 2, period_ns=PERIOD_NS).t_ns[0])
    session = Session(
        id="20200101T000000Z-000000",
        name="",
        node="n",
        state="sealed",
        started_t_ns=begin_ns,
        parts=(Part(stream_id="one", seq_first=0, seq_last=1),),
        scene="s",
        markers=tuple(
            Marker(id=label, label=label, t_ns=begin_ns + round(at_s * 1e9))
            for label, at_s in labels.items()
        ),
    )
    write_markers(session, folder)


def test_marks_of_the_session_are_its_trials(tmp_path: Path) -> None:
    path = seal(tmp_path / "ours", bias_n=0.3)
    other = seal(tmp_path / "theirs")
    marker(tmp_path / "ours", walk=2.0, turn=11.0, gone=500.0)
    found = compare_session(path, other, OWN)
    assert found.trial_definition == "from marker to marker"
    assert [trial.name for trial in found.errors.trials] == ["1: walk", "2: turn"]
    for trial in found.errors.trials:
        assert trial.figures["grf_bias_n"] == pytest.approx(0.3, abs=0.02)
    over = found.errors.figures["grf_bias_n"]
    assert (over.trials, over.method) == (2, "t")
    assert any("'gone' begins no trial" in note for note in found.notes)


def test_another_session_is_compared_by_its_own_clock(tmp_path: Path) -> None:
    path, other = seal(tmp_path / "ours"), seal(tmp_path / "theirs", later_s=0.25)
    found = compare_session(path, other, OWN)
    assert found.alignment.lag_s.value == pytest.approx(0.25, abs=2e-3)
    assert found.trial_definition == "each contiguous recording"
    assert found.errors.figures["grf_mae_n"].mean < 0.1


def test_the_lag_by_forces_stands_beside_that_by_the_clock_tables_of_one_server(
    tmp_path: Path,
) -> None:
    # The other node's clock is a quarter of a second ahead of the server's.
    path = seal(tmp_path / "ours")
    other = seal(tmp_path / "theirs", later_s=0.25, server_minus_node_s=-0.25)
    found = compare_session(path, other, OWN)
    assert found.clock_lag is not None
    assert found.clock_lag.lag_s == pytest.approx(0.25, abs=1e-6)
    assert found.clock_lag.error_bound_s == pytest.approx(0.001, abs=2e-4)
    assert found.alignment.lag_s.value == pytest.approx(found.clock_lag.lag_s, abs=2e-3)
    assert not any("the clocks say" in note for note in found.notes)
    said = format_comparison_report(
        "ours",
        found.alignment,
        found.clock_lag,
        found.pairs,
        found.errors,
        found.trial_definition,
        found.notes,
    )
    assert "| the same lag by the clock tables, and its bounds, ms | 250.0" in said


def test_forces_and_clocks_that_contradict_each_other_are_said(tmp_path: Path) -> None:
    path = seal(tmp_path / "ours")
    other = seal(tmp_path / "theirs", later_s=0.25, server_minus_node_s=0.5)
    found = compare_session(path, other, OWN)
    assert any("the clocks say a lag of -500.000 ms" in note for note in found.notes)


def test_the_clocks_give_no_lag_if_one_session_lacks_its_clock_table(tmp_path: Path) -> None:
    path, other = seal(tmp_path / "ours"), seal(tmp_path / "theirs")
    (tmp_path / "theirs" / "clock.parquet").unlink()
    assert compare_session(path, other, OWN).clock_lag is None


def test_forces_of_the_tiles_stand_beside_the_frames_that_are_compared(tmp_path: Path) -> None:
    path, other = seal(tmp_path / "ours"), seal(tmp_path / "theirs")
    found = compare_session(path, other, OWN)
    np.testing.assert_allclose(
        found.tile_force_n.sum(axis=1), found.pairs.columns["grf_n"], atol=1e-5
    )


def test_a_column_that_a_session_has_not_is_refused(tmp_path: Path) -> None:
    path = seal(tmp_path / "ours")
    options = CompareOptions(ReferenceOptions({"grf_n": "true_grf_n"}))
    with pytest.raises(FileFormatError, match="no column 'true_grf_n'"):
        compare_session(path, path, options)

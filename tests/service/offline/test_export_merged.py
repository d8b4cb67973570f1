"""Sealed sessions into one file, from their folders on the disk."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devices.errors import UsageError
from service.offline.export import ExportOptions, export_merged, export_session
from storage.clock.log import ClockOffset
from storage.clock.table import CLOCK_NAME, StreamClockFacts, write_clock_file
from storage.formats.slice import Slice
from storage.schema import Array
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import UTC_NS
from tests.builders.frames import make_frames
from tests.storage.formats.walks import ARRAY, ROWS, walk

ezc3d = pytest.importorskip("ezc3d")

TOGETHER = ExportOptions("c3d", clock="server")


def sealed(folder: Path, node: str, later_ns: int, keep: Array | None = None) -> Path:
    """A session of a node whose clock is behind the server's by so much; None: all frames."""
    folder.mkdir()
    info = ARRAY.model_copy(update={"node": node, "stream_id": node.ljust(32, "0")})
    with SealedFileWriter(folder / FRAMES_NAME, info, {}) as writer:
        kept = np.arange(ROWS) if keep is None else keep
        columns = {name: values[kept] for name, values in walk().items()}
        writer.append_frames(make_frames(kept, len(info.tiles)), columns)
    row = ClockOffset(
        stream_id=info.stream_id, t_mono_ns=0, server_minus_node_ns=later_ns, uncertainty_ns=400_000
    )
    write_clock_file(folder / CLOCK_NAME, [row], [StreamClockFacts(info.stream_id, UTC_NS, True)])
    return folder / FRAMES_NAME


@pytest.fixture(scope="module")
def feet(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("feet")
    return [sealed(folder / "l", "left", 0), sealed(folder / "r", "right", 300_000_000)]


def test_two_sealed_sessions_are_two_platforms_of_one_file(
    feet: list[Path], tmp_path: Path
) -> None:
    done = export_merged(feet, tmp_path / "take.c3d", TOGETHER)
    assert done.size_bytes == (tmp_path / "take.c3d").stat().st_size
    read = ezc3d.c3d(str(tmp_path / "take.c3d"), extract_forceplat_data=True)
    left_n, right_n = (-plate["force"][2] for plate in read["data"]["platform"])
    assert len(left_n) == ROWS + 150
    np.testing.assert_allclose(left_n[:ROWS], right_n[150:], atol=1e-3)
    contexts = read["parameters"]["EVENT"]["CONTEXTS"]["value"]
    assert sorted(set(contexts)) == ["Left", "Right"]


def test_sessions_that_cannot_be_merged_leave_no_file(feet: list[Path], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="its markers are unknown"):
        export_merged(feet, tmp_path / "take.c3d", replace(TOGETHER, markers=True))
    assert not list(tmp_path.iterdir())


def test_a_session_on_the_servers_axis_states_its_uncertainty(
    feet: list[Path], tmp_path: Path
) -> None:
    export_session(feet[1], tmp_path / "right.c3d", TOGETHER)
    read = ezc3d.c3d(str(tmp_path / "right.c3d"))
    labels = read["parameters"]["ANALOG"]["LABELS"]["value"]
    bound_s = read["data"]["analogs"][0, labels.index("t_server_uncertainty_s")]
    assert (bound_s >= 400e-6).all()
    (begin,) = read["parameters"]["FOOTTILE"]["BEGIN_T_NS"]["value"]
    assert int(begin) == UTC_NS + 300_000_000


def test_a_slice_of_two_sessions_is_one_range_of_the_servers_clock(
    feet: list[Path], tmp_path: Path
) -> None:
    part = Slice(0.5, 1.0)
    export_merged(feet[::-1], tmp_path / "take.c3d", replace(TOGETHER, part=part))
    read = ezc3d.c3d(str(tmp_path / "take.c3d"), extract_forceplat_data=True)
    right_n, left_n = (-plate["force"][2] for plate in read["data"]["platform"])
    grf_n = np.where(walk()["contact"] == 1, walk()["grf_n"], 0.0)
    np.testing.assert_allclose(left_n, -grf_n[250:500], atol=1e-3)
    np.testing.assert_allclose(right_n, -grf_n[100:350], atol=1e-3)
    with pytest.raises(UsageError, match="no frame is in this slice"):
        export_merged(feet, tmp_path / "take.c3d", replace(TOGETHER, part=Slice(0.0, 0.25)))


@pytest.mark.parametrize("number", [0, 1], ids=["left", "right"])
def test_a_refused_gap_names_a_slice_that_works(
    number: int, feet: list[Path], tmp_path: Path
) -> None:
    folder = sealed(tmp_path / "gap", "left", 0, keep=np.delete(np.arange(ROWS), range(600, 640)))
    both = [folder, feet[number]] if number else [folder]
    write = export_merged if number else lambda sources, *rest: export_session(sources[0], *rest)
    with pytest.raises(UsageError, match="too long for a line") as refused:
        write(both, tmp_path / "x.zip", replace(TOGETHER, to="opensim"))
    edges = re.search(r"from ([0-9.]+) s to ([0-9.]+) s", str(refused.value))
    assert edges
    part = Slice(float(edges[1]), float(edges[2]))
    done = write(both, tmp_path / "x.zip", replace(TOGETHER, to="opensim", part=part))
    assert done.size_bytes > 0
    assert part.end_s == pytest.approx(599 / 500.0, abs=2e-3)

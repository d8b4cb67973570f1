"""Two nodes' sessions on one axis, as docs/formats.md tells users to do it, from exported files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from storage.clock.bounds import OffsetRows
from storage.clock.table import ClockTable, StreamClockFacts
from storage.formats.export import make_one_pass_frame_source
from storage.formats.slice import Slice
from tests.builders.arrays import make_array
from tests.builders.frames import make_frames
from tests.storage.formats.exports import export

ROOT = Path(__file__).resolve().parents[3]
SECOND = 1_000_000_000
BEGIN_NS = 1_767_225_600 * SECOND
"""The server's UTC of the first frames."""
PERIOD_NS = 20_000_000
FRAMES = 3000


class Node:
    """A node whose clock is wrong, drifts, and is compared over a lopsided network.

    Its frame i was taken at `taken_ns[i]` of the server's UTC, which no file says.
    """

    def __init__(self, name: str, *, behind_ns: int, drift_ppm: float, late_ns: int) -> None:
        self.name = name
        self.taken_ns = BEGIN_NS + late_ns + PERIOD_NS * np.arange(FRAMES, dtype=np.int64)
        self._booted_ns = 50 * SECOND
        self._rate = 1 + drift_ppm * 1e-6
        self._utc_offset_ns = BEGIN_NS - behind_ns - self._booted_ns

    def read_ns(self, server_ns: Any) -> Any:
        """Its monotonic clock at these instants of the server's."""
        return self._booted_ns + np.rint((server_ns - BEGIN_NS) / self._rate).astype(np.int64)

    def rows(self, seed: int) -> OffsetRows:
        random = np.random.default_rng(seed)
        sent_ns = BEGIN_NS + 10 * SECOND * np.arange(7, dtype=np.int64)
        go_ns = np.rint(3e5 + random.exponential(1e6, 7)).astype(np.int64)
        back_ns = np.rint(3e5 + random.exponential(6e6, 7)).astype(np.int64)
        sent, came = self.read_ns(sent_ns), self.read_ns(sent_ns + go_ns + back_ns)
        middle = (sent + came) // 2
        offset = sent_ns + go_ns - middle - self._utc_offset_ns
        return OffsetRows(middle, offset, (came - sent + 1) // 2)

    def export(self, path: Path, seed: int, *, measured_parts: int) -> None:
        """Write what `foottile export --clock server` does, of two parts, measured or not."""
        info = make_array(
            1,
            node=self.name,
            stream_id="first",
            nominal_rate_hz=1e9 / PERIOD_NS,
            utc_offset_ns=self._utc_offset_ns,
            clock_set=False,
        )
        frames = make_frames(
            FRAMES, 1, t_mono_ns=self.read_ns(self.taken_ns), utc_offset_ns=self._utc_offset_ns
        )
        part = (np.arange(FRAMES) >= FRAMES - 100).astype(np.uint16)
        names = ["first", "second"]
        rows = dict.fromkeys(names[:measured_parts], self.rows(seed))
        clock = ClockTable(rows, [StreamClockFacts(name) for name in names], names)
        pieces = iter([(frames, {"part": part})])
        path.write_bytes(
            b"".join(
                export(make_one_pass_frame_source(pieces), info, {}, "parquet", Slice(), clock)
            )
        )


@pytest.fixture
def nodes(tmp_path: Path) -> tuple[Node, Node]:
    """The left one is an hour behind and slow, the right one fast, and it was never set."""
    left = Node("left", behind_ns=3600 * SECOND, drift_ppm=40.0, late_ns=0)
    right = Node("right", behind_ns=BEGIN_NS - SECOND, drift_ppm=-25.0, late_ns=3_000_000)
    left.export(tmp_path / "left.parquet", 1, measured_parts=1)
    right.export(tmp_path / "right.parquet", 2, measured_parts=2)
    return left, right


def documented() -> str:
    section = (
        (ROOT / "docs" / "formats.md").read_text("utf-8").split("### Two sessions on one axis")
    )
    return section[1].split("```python\n")[1].split("```")[0]


def test_the_documented_lines_put_two_sessions_on_one_axis(
    nodes: tuple[Node, Node], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pandas", reason="the lines for users need pandas, foottile does not")
    monkeypatch.chdir(tmp_path)
    said: dict[str, Any] = {}
    exec(documented(), said)  # noqa: S102  # our own page
    both = said["both"].astype({"seq_left": "int64"})
    assert both["seq_left"].tolist() == list(range(FRAMES - 100))  # the last part is unmeasured
    both = both.dropna(subset=["seq_right"]).astype({"seq_right": "int64"})
    assert len(both) == FRAMES - 100
    check(
        nodes,
        *(both[name].to_numpy(dtype=np.int64) for name in ("seq_left", "seq_right")),
        *(both[name].to_numpy(dtype=np.int64) for name in ("apart_ns", "apart_uncertainty_ns")),
    )


def test_nearest_frames_of_two_sessions_are_apart_as_is_said(
    nodes: tuple[Node, Node], tmp_path: Path
) -> None:
    """The same by hand."""
    axes, bounds = [], []
    for name in ("left", "right"):
        columns = ["t_server_ns", "t_server_uncertainty_ns"]
        table = pq.read_table(tmp_path / f"{name}.parquet", columns=columns).drop_null()
        axes.append(table["t_server_ns"].to_numpy())
        bounds.append(table["t_server_uncertainty_ns"].to_numpy())
    assert [len(axis) for axis in axes] == [FRAMES - 100, FRAMES]
    left, right = axes
    after = np.clip(np.searchsorted(right, left), 1, FRAMES - 1)
    nearest = np.where(left - right[after - 1] <= right[after] - left, after - 1, after)
    seq = np.arange(len(left))
    check(nodes, seq, nearest, right[nearest] - left, bounds[0] + bounds[1][nearest])


def check(nodes: tuple[Node, Node], one: Any, other: Any, apart_ns: Any, bound_ns: Any) -> None:
    left, right = nodes
    truth_ns = right.taken_ns[other] - left.taken_ns[one]
    assert (np.abs(apart_ns - truth_ns) <= bound_ns).all()
    assert bound_ns.max() < 20_000_000

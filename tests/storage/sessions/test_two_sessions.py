"""Two nodes' sessions on one axis, as docs/formats.md tells users to do it, from exported files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from storage.clock.table import ClockTable, StreamClockFacts
from storage.formats.export import make_one_pass_frame_source
from storage.formats.slice import Slice
from tests.builders.arrays import UTC_NS, make_array
from tests.builders.frames import make_frames
from tests.storage.clock.clocks import BEGIN_NS, HOUR, SECOND, Clock, Int64, every
from tests.storage.formats.exports import export
from tests.storage.formats.walks import DOCUMENT

PERIOD_NS = 20_000_000
FRAMES = 3000


def write_export(path: Path, clock: Clock, *, late_ns: int, measured_parts: int) -> Int64:
    """Write what `foottile export --clock server` does; return the server's times of frames."""
    t_mono_ns = BEGIN_NS + late_ns + PERIOD_NS * np.arange(FRAMES, dtype=np.int64)
    utc_offset_ns = UTC_NS - clock.offset_ns
    info = make_array(
        1, node=path.stem, stream_id="first", utc_offset_ns=utc_offset_ns, clock_set=False
    )
    frames = make_frames(FRAMES, 1, t_mono_ns=t_mono_ns, utc_offset_ns=utc_offset_ns)
    part = (np.arange(FRAMES) >= FRAMES - 100).astype(np.uint16)
    names = ["first", "second"]
    rows = dict.fromkeys(names[:measured_parts], clock.measured(every(10, 7), late_ns, slow_ns=1e6))
    table = ClockTable(rows, [StreamClockFacts(name) for name in names], names)
    content = make_one_pass_frame_source(iter([(frames, {"part": part})]))
    path.write_bytes(b"".join(export(content, info, {}, "parquet", Slice(), table)))
    return t_mono_ns + utc_offset_ns + clock.at(t_mono_ns)


def test_the_documented_lines_put_two_sessions_on_one_axis(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The left clock is an hour behind and slow, the right one fast, and it was never set."""
    pytest.importorskip("pandas", reason="the lines for users need pandas, foottile does not")
    slow, fast = Clock((40.0,), HOUR), Clock((-25.0,), UTC_NS - SECOND)
    left_ns = write_export(tmp_path / "left.parquet", slow, late_ns=0, measured_parts=1)
    right_ns = write_export(tmp_path / "right.parquet", fast, late_ns=3_000_000, measured_parts=2)
    monkeypatch.chdir(tmp_path)
    section = DOCUMENT.read_text("utf-8").split("### Two sessions on one axis")[1]
    said: dict[str, Any] = {}
    exec(section.split("```python\n")[1].split("```")[0], said)  # noqa: S102  # our own page
    both = said["both"].astype({"seq_left": "int64"})
    assert both["seq_left"].tolist() == list(range(FRAMES - 100))  # the last part is unmeasured
    both = both.dropna(subset=["seq_right"]).astype({"seq_right": "int64"})
    assert len(both) == FRAMES - 100
    one, other, apart_ns, bound_ns = (
        both[name].to_numpy(dtype=np.int64)
        for name in ("seq_left", "seq_right", "apart_ns", "apart_uncertainty_ns")
    )
    assert (np.abs(apart_ns - (right_ns[other] - left_ns[one])) <= bound_ns).all()
    assert bound_ns.max() < 20_000_000

"""A force plate under a session that was recorded, and `foottile compare` with what it wrote."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest

from service.cli.main import main
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording

LAG_S = 0.25
"""The plate's clock is ahead of the session's by so much."""
ZERO_N = 1.5
"""What the plate reads of nothing."""
RATE_HZ = 1000.0
_STANCES = ((40.0, 90), (80.0, 130), (60.0, 110), (70.0, 150), (50.0, 100), (75.0, 120), (65.0, 90))
"""Newtons and frames: no two are alike, so that no other lag fits."""


def hopped(node: FakeNode, **about: object) -> Recording:
    """A sealed session of seven stances that differ."""
    session = node.record(**about)
    for force_n, frames in _STANCES:
        node.send(2 * frames, [0.0, 0.0], alive=True)
        node.send(frames, [0.25 * force_n, 0.75 * force_n], alive=True)
    node.deliver(200, [0.0, 0.0], alive=True)
    node.finish(session)
    return session


def write_plate(session: Recording, path: Path) -> None:
    """What a plate would have written of the session's own estimates, with a clock of its own."""
    table = pq.read_table(session.folder / "frames.parquet", columns=["t_ns", "grf_n", "cop_x_m"])
    t_ns, grf_n, cop_m = (table[name].to_numpy() for name in table.column_names)
    t_s, known = (t_ns - t_ns[0]) * 1e-9, np.isfinite(grf_n)
    at_s = np.arange(t_s[known][0] + 0.2, t_s[-1] - 0.2, 1 / RATE_HZ)
    noise_n = 0.3 * np.random.default_rng(1).normal(size=len(at_s))
    force_n = np.interp(at_s, t_s[known], grf_n[known]) + ZERO_N + noise_n
    columns = {
        "time_s": at_s + LAG_S,
        "grf_n": force_n,
        "cop_x_m": np.full(len(at_s), float(np.nanmean(cop_m))),
        "cop_y_m": np.zeros(len(at_s)),
    }
    pyarrow.csv.write_csv(pa.table(columns), path)


def compare(session: Recording, reference: Path, *options: str) -> int:
    """Run `foottile compare` on the session's folder; its exit code."""
    asked = ["foottile", "compare", str(session.folder), "--reference", str(reference), *options]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", asked)
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
    return 0

"""`foottile compare --manifest`: each session with the reference of its row."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.service.cli.outcome import Run

pytestmark = pytest.mark.slow


def plate_of(session: Path, path: Path, *, unit: float = 1.0) -> None:
    """What a plate would have written of our own estimate, with noise."""
    table = pq.read_table(session)
    t_s = (table["t_ns"].to_numpy() - table["t_ns"][0].as_py()) * 1e-9
    grf_n = table["grf_n"].to_numpy().astype(float)
    known = np.isfinite(grf_n)
    noise_n = 0.01 * np.ptp(grf_n[known]) * np.random.default_rng(1).normal(size=known.sum())
    rows = zip(t_s[known], (grf_n[known] + noise_n) * unit, strict=True)
    path.write_text("t,F\n" + "".join(f"{t:.6f},{f:.9f}\n" for t, f in rows))


def test_each_row_is_compared_and_a_bad_one_fails_alone(
    run: Run, session: Path, tmp_path: Path
) -> None:
    plate_of(session, tmp_path / "newtons.csv")
    plate_of(session, tmp_path / "kilo.csv", unit=1e-3)
    kilo = (tmp_path / "kilo.csv").read_text()
    (tmp_path / "kilo.csv").write_text("a,b\n1,2\n" + kilo)
    rows = [
        "session,reference,name,units,sign,skip_rows,encoding",
        "session.parquet,newtons.csv,first,,,,",
        'session.parquet,kilo.csv,second,"grf=kN,time=s",,2,cp1252',
        "session.parquet,gone.csv,third,,,,",
        "session.parquet,newtons.csv,fourth,grf,,,",
        "session.parquet,newtons.csv,../fifth,,,,",
        "session.parquet,,sixth,,,,",
        "session.parquet,newtons.csv,seventh,,,1.5,",
    ]
    (tmp_path / "trials.csv").write_text("\n".join(rows) + "\n")
    asked = ("--map", "time_s=t,grf_n=F", "--units", "grf=N,time=s", "--sign", "+")
    words = ("compare", "--manifest", "trials.csv", "--out", "out", *asked, "--jobs", 1)
    done = run(*words, "--json")
    assert done.code == 3
    said: dict[str, list[dict[str, Any]]] = {}
    for line in map(json.loads, done.out.splitlines()):
        said.setdefault(line["name"], []).append(line)
    assert said["first"][0]["state"] == said["second"][0]["state"] == "made", [
        e.get("reason") for v in said.values() for e in v
    ]
    first, second = (said[name][0]["facts"]["means"] for name in ("first", "second"))
    assert first["grf_mae_n"] == pytest.approx(second["grf_mae_n"], rel=0.01)
    assert {p.name for p in (tmp_path / "out" / "first").iterdir()} == {
        "compare.json",
        "compare.md",
        "compare.png",
        "series.parquet",
        "compare.made.json",
    }
    reasons = [line["reason"] for lines in said.values() for line in lines if "reason" in line]
    assert len(reasons) == 5
    for word in ("no such file", "--units 'grf'", "../fifth", "no reference", "--skip-rows '1.5'"):
        assert any(word in reason for reason in reasons), reasons
    again = run(*words)
    assert "0 made, 2 there before, 5 failed" in again.out
    missed = run(*words, "--limits", "grf_mae_n=1e-9")
    assert "2 made, 0 there before, 5 failed; 2 limit missed" in missed.out


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("s.parquet",),
        ("--manifest", "list.csv"),
        ("--manifest", "list.csv", "--out", "o", "--reference", "x.csv"),
        ("--manifest", "list.csv", "--out", "o", "--units", "grf"),
        ("--manifest", "list.csv", "--out", "o", "--decimal", ";"),
    ],
)
def test_a_repeated_or_missing_argument_is_wrong_usage(
    run: Run, tmp_path: Path, words: tuple[str, ...]
) -> None:
    (tmp_path / "list.csv").write_text("session,reference\na.parquet,b.csv\n")
    run("compare", *words).fails(2)

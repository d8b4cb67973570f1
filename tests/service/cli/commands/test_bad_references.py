"""References that are wrong in every way that happens: refused or said, as docs have it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from devices.arrays import Floats
from tests.service.cli.outcome import Run
from tests.service.offline.compare.gaits import Gait

pytestmark = pytest.mark.slow

TABLE = Path(__file__).parents[4] / "docs/results/bad-references.md"

Rows = tuple[Floats, Floats]
"""Instants and forces of a good reference, 1000 a second."""


def _empty(rows: Rows) -> str:
    return "time_s,grf_n\n"


def _text(t_s: Floats, force_n: Floats) -> str:
    forces = ("" if np.isnan(force) else f"{force:.5f}" for force in force_n.tolist())
    lines = (f"{t:.6f},{force}" for t, force in zip(t_s.tolist(), forces, strict=True))
    return "time_s,grf_n\n" + "\n".join(lines) + "\n"


def _flight(rows: Rows) -> str:
    noise_n = 0.05 * np.random.default_rng(1).normal(size=len(rows[0]))
    return _text(rows[0], noise_n)


def _with(change: Callable[[Floats, Floats], tuple[Floats, Floats]]) -> Callable[[Rows], str]:
    return lambda rows: _text(*change(rows[0].copy(), rows[1].copy()))


def _gap(t_s: Floats, force_n: Floats) -> Rows:
    kept = (t_s < 3.0) | (t_s > 3.2)
    return t_s[kept], force_n[kept]


def _holes(t_s: Floats, force_n: Floats) -> Rows:
    force_n[2000:2100] = np.nan
    return t_s, force_n


def _swapped(t_s: Floats, force_n: Floats) -> Rows:
    t_s[[500, 501]] = t_s[[501, 500]]
    return t_s, force_n


def _repeated(t_s: Floats, force_n: Floats) -> Rows:
    t_s[501] = t_s[500]
    return t_s, force_n


def _other(t_s: Floats, force_n: Floats) -> Rows:
    rng = np.random.default_rng(4)
    return t_s, Gait(rng, float(t_s[-1]) + 1.0).at(t_s - t_s[0]) + 0.05 * rng.normal(size=len(t_s))


CASES: dict[str, tuple[Callable[[Rows], str], tuple[object, ...]]] = {
    "empty": (_empty, ()),
    "one sample": (lambda rows: _text(rows[0][:1], rows[1][:1]), ()),
    "all flight": (_flight, ()),
    "no force in any sample": (_with(lambda t_s, force_n: (t_s, force_n * np.nan)), ()),
    "zero throughout": (_with(lambda t_s, force_n: (t_s, 0.0 * force_n)), ()),
    "two instants swapped": (_with(_swapped), ()),
    "an instant twice": (_with(_repeated), ()),
    "time runs backwards": (_with(lambda t_s, force_n: (t_s[::-1], force_n)), ()),
    "a gap of 0.2 s": (_with(_gap), ()),
    "0.1 s without a force": (_with(_holes), ()),
    "kilonewtons": (_with(lambda t_s, force_n: (t_s, 1e-3 * force_n)), ()),
    "millinewtons": (_with(lambda t_s, force_n: (t_s, 1e3 * force_n)), ()),
    "the other sign": (_with(lambda t_s, force_n: (t_s, -force_n)), ()),
    "another time": (_with(lambda t_s, force_n: (t_s, force_n)), ("--lag-range-s", "500,600")),
    "milliseconds as `time_s`": (_with(lambda t_s, force_n: (1e3 * t_s, force_n)), ()),
    "Unix time": (_with(lambda t_s, force_n: (1.7e9 + t_s, force_n)), ()),
    "Unix time in milliseconds": (_with(lambda t_s, force_n: (1e3 * (1.7e9 + t_s), force_n)), ()),
    "decimal commas": (lambda rows: _text(*rows).replace(",", ";").replace(".", ","), ()),
    "a line of units below the names": (lambda rows: _text(*rows).replace("\n", "\ns,N\n", 1), ()),
    "a title above the names": (lambda rows: "Plate 1 of 2\n" + _text(*rows), ()),
    "another subject": (_with(_other), ()),
}
"""By what is wrong: the file, and options."""


def rows_of(table: str) -> dict[str, tuple[int, str]]:
    """By what is wrong: exit code, and what is said."""
    cells = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")]
    return {row[0]: (int(row[1]), row[2].strip("`")) for row in cells if row[1].isdigit()}


def test_every_case_stands_in_the_table() -> None:
    assert list(rows_of(TABLE.read_text("utf-8"))) == list(CASES)


@pytest.mark.parametrize("wrong", CASES)
def test_a_wrong_reference_is_refused_or_named_and_never_gives_a_plausible_number(
    run: Run, session: Path, tmp_path: Path, wrong: str
) -> None:
    make, options = CASES[wrong]
    code, says = rows_of(TABLE.read_text("utf-8"))[wrong]
    table = pq.read_table(session)
    t_s = (table["t_ns"].to_numpy() - table["t_ns"][0].as_py()) * 1e-9
    at_s = np.arange(0.3, t_s[-1] - 0.3, 0.001)
    noise_n = 0.05 * np.random.default_rng(2).normal(size=len(at_s))
    force_n = np.interp(at_s, t_s, table["true_grf_n"].to_numpy()) + noise_n
    (tmp_path / "plate.csv").write_text(make((at_s + 1.5, force_n)))
    outcome = run("compare", session, "--reference", "plate.csv", "--out", "o", *options)
    assert outcome.code == code
    assert says in " ".join((outcome.err + outcome.out).split())
    assert Path("o").exists() == (code == 0)

"""Stances of emulated feet against the true ones: their number, begins and ends (docs/method.md).

    python benchmarks/contact.py [--loads FOLDER] [--data DIR]

Built-in scenes with both chips and, if FOLDER has the recordings `insole_walk_left.csv` and
`insole_walk_right.csv`, walks on the insole at several scales. True contact is a Schmitt trigger on
`true_grf_n`: on at 2 % of the largest force, off at 1 %, each for 10 ms. Begins and ends are found
less true, for the stances that overlap most. Recordings stay in DIR and are used again.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
from stance_intervals import run_foottile

from devices.arrays import Bools, Floats

ON_SHARE, OFF_SHARE, LASTS_S = 0.02, 0.01, 0.01
CHIPS = ("mpl115a2", "bmp581")
SCENES = {
    "standing": ["--seconds=8"],
    "rolling": ["--seconds=9"],
    "poppy": [],
    "mud": [],
}
WALKS = [("left", 0.005), ("left", 0.01), ("left", 0.02), ("left", 0.05), ("left", 0.1)]
WALKS += [("right", 0.05)]


def list_recordings(loads: Path | None) -> Iterator[tuple[str, list[str]]]:
    """Yield name and options of each recording."""
    for scene, chip in product(SCENES, CHIPS):
        yield f"{scene}-{chip}", [f"--scene={scene}", f"--chip={chip}", *SCENES[scene]]
    if loads is None:
        return
    for (side, scale), chip in product(WALKS, CHIPS):
        load = loads / f"insole_walk_{side}.csv"
        options = ["--scene=insole", f"--chip={chip}", "--seconds=10", f"--load={load}"]
        yield f"insole-{side}-{scale:g}-{chip}", [*options, f"--load-scale={scale:g}"]


def detect_true_contact(t_s: Floats, force_n: Floats) -> Bools:
    """Return the frames with true contact, (n,)."""
    on_n, off_n = ON_SHARE * force_n.max(), OFF_SHARE * force_n.max()
    is_decided = (force_n >= on_n) | (force_n <= off_n)
    last = np.maximum.accumulate(np.where(is_decided, np.arange(len(force_n)), 0))
    contact: Bools = force_n[last] >= on_n
    for begin, end in find_runs(np.ones_like(contact), contact):
        if t_s[min(end, len(t_s) - 1)] - t_s[begin] < LASTS_S and begin:
            contact[begin:end] = contact[begin - 1]
    return contact


def find_runs(rows: Bools, values: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first row, and row after the last, of runs of equal values within some rows."""
    edges = np.flatnonzero(np.diff(values)) + 1
    runs = zip([0, *edges.tolist()], [*edges.tolist(), len(values)], strict=True)
    return [(begin, end) for begin, end in runs if rows[begin]]


def make_row(name: str, path: Path) -> str:
    """Return the table row of a recording."""
    table = pq.read_table(path, columns=["t_ns", "true_grf_n", "contact", "cop_x_m"])
    t_ns, true_n = table["t_ns"].to_numpy(), table["true_grf_n"].to_numpy()
    t_s = (t_ns - t_ns[0]) * 1e-9
    contact = table["contact"].to_numpy() == 1.0
    true = detect_true_contact(t_s, true_n)
    stances, true_stances = find_runs(contact, contact), find_runs(true, true)
    edges_ms = []
    for begin, end in true_stances:
        overlaps = [min(end, e) - max(begin, b) for b, e in stances]
        if overlaps and max(overlaps) > 0:
            b, e = stances[int(np.argmax(overlaps))]
            edges_ms.append((t_s[b] - t_s[begin], t_s[e - 1] - t_s[end - 1]))
    spreads = [
        f"{1e3 * np.min(each):+.0f}, {1e3 * np.median(each):+.0f}, {1e3 * np.max(each):+.0f}"
        for each in np.array(edges_ms).T
    ] or ["", ""]
    cops = int(table["cop_x_m"].is_valid().to_numpy().sum())
    cells = (f"`{name}`", len(true_stances), len(stances), *spreads, cops)
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--loads", type=Path)
    parser.add_argument("--data", type=Path)
    options = parser.parse_args()
    print("| recording | true stances | found | begin, ms | end, ms | frames with COP |")
    print("|---|--:|--:|---|---|--:|")
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.data or Path(temporary)
        for name, arguments in list_recordings(options.loads):
            path = folder / f"{name}.parquet"
            if not path.exists():
                run_foottile("simulate", f"--out={path}", "--truth", *arguments)
            print(make_row(name, path), flush=True)


if __name__ == "__main__":
    main()

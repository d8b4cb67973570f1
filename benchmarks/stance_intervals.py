"""How often the 95 % intervals of stances hold the truth of emulated feet (docs/method.md).

    python benchmarks/stance_intervals.py [--draws N] [--data DIR]

Built-in scenes, and two loads that are drawn here: `walking` on the insole, and `taps` of 40 to
120 ms on the foot of `standing`. `largest frame` is the largest GRF with the sigma of its frame, as
a peak without regard to noise. Recordings stay in DIR and are used again.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from devices.arrays import Floats
from service.cli.main import main as foottile
from service.sessions.stances import compute_stances
from storage.sessions.reader import SealedFileReader

DRAWS = 12
PARTS = 4
"""Number of draws with other parts; the rest of the draws have other noise and ground."""
SCENES = {
    "rolling": ["--scene=rolling", "--seconds=36"],
    "poppy": ["--scene=poppy", "--seconds=12"],
    "mud": ["--scene=mud", "--seconds=12"],
    "walking": ["--scene=insole"],
    "taps": ["--scene=standing"],
}
SIGMAS = {
    "largest frame": "largest frame sigma",
    "peak_grf_n": "peak_sigma_n",
    "duration_s": "duration_sigma_s",
    "impulse_n_s": "impulse_sigma_n_s",
    "cop_x_range_m": "cop_x_range_sigma_m",
}
"""Figures, and their standard uncertainties."""
_NAMES = ("t_ns", "grf_n", "grf_sigma_n", "cop_x_m", "true_grf_n", "true_cop_x_m")
_LOAD_SECONDS = 36.0


def _draw_walk(rng: np.random.Generator) -> tuple[float, Callable[[Floats], Floats]]:
    """Draw a contact time, and the force over it from 0 to 1: two humps."""
    peak_n, dip = rng.uniform(30.0, 40.0), rng.uniform(0.3, 0.4)
    return rng.uniform(
        0.6, 0.8
    ), lambda s: peak_n * (np.sin(np.pi * s) + dip * np.sin(3 * np.pi * s))


def _draw_tap(rng: np.random.Generator) -> tuple[float, Callable[[Floats], Floats]]:
    """Draw a contact time, and the force over it from 0 to 1: a sharp or a blunt half sine."""
    peak_n, power = rng.uniform(15.0, 40.0), rng.uniform(0.7, 1.5)
    return rng.uniform(0.04, 0.12), lambda s: peak_n * np.sin(np.pi * s) ** power


def write_load(scene: str, seed: int, path: Path) -> None:
    """Write a load of contacts with flights of 0.4 to 0.8 s between them."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, _LOAD_SECONDS, 0.001)
    force_n, cop_x_m, begin_s = np.zeros_like(t_s), np.zeros_like(t_s), 1.0
    while True:
        contact_s, shape = (_draw_walk if scene == "walking" else _draw_tap)(rng)
        if begin_s + contact_s > _LOAD_SECONDS - 0.5:
            break
        share = (t_s - begin_s) / contact_s
        rows = (share > 0.0) & (share < 1.0)
        force_n[rows] = shape(share[rows])
        if scene == "walking":
            cop_x_m[rows] = -0.06 + 0.12 * share[rows]
        begin_s += contact_s + rng.uniform(0.4, 0.8)
    table = np.column_stack([t_s, force_n, cop_x_m, np.zeros_like(t_s)])
    header = "time_s,fz_n,cop_x_m,cop_y_m"
    np.savetxt(path, table, fmt="%.5f", delimiter=",", header=header, comments="")


def simulate(scene: str, seed: int, path: Path) -> None:
    """Write a session of other parts and other noise."""
    options = [f"--seed={seed}", f"--parts-seed={seed % PARTS}", "--truth", *SCENES[scene]]
    if scene in ("walking", "taps"):
        load = path.with_suffix(".csv")
        write_load(scene, seed, load)
        options.append(f"--load={load}")
    run_simulate(path, options)


def run_simulate(path: Path, options: list[str]) -> None:
    """Run `foottile simulate` in this process."""
    sys.argv = ["foottile", "simulate", f"--out={path}", *options]
    try:
        foottile()
    except SystemExit as ended:
        if ended.code:
            raise


def compare_stances(path: Path) -> Iterator[tuple[dict[str, Any], dict[str, float]]]:
    """Yield each whole stance of a session with its true figures."""
    table = pq.read_table(path, columns=list(_NAMES))
    t_ns, grf_n, sigma_n, cop_m, true_n, true_m = (table[name].to_numpy() for name in _NAMES)
    t_s = (t_ns - t_ns[0]) * 1e-9
    with SealedFileReader(path) as session:
        stances = [row for row in compute_stances(session).to_pylist() if row["is_whole"]]
    edges = [np.searchsorted(t_ns, [row["begin_t_ns"], row["end_t_ns"]]) for row in stances]
    if not edges:
        return
    # The thresholds of contact are between the forces on either side of its edges.
    on_n = 0.5 * (max(grf_n[i - 1] for i, _ in edges) + min(grf_n[i] for i, _ in edges))
    off_n = 0.5 * (max(grf_n[j + 1] for _, j in edges) + min(grf_n[j] for _, j in edges))
    for row, (i, j) in zip(stances, edges, strict=True):
        begin_s, first = _crossing(t_s, true_n, int(i), on_n, -1)
        end_s, last = _crossing(t_s, true_n, int(j), off_n, 1)
        stated = np.isfinite(cop_m[i : j + 1]) & np.isfinite(true_m[i : j + 1])
        largest = int(i) + int(np.argmax(grf_n[i : j + 1]))
        of_frame = {"largest frame": grf_n[largest], "largest frame sigma": sigma_n[largest]}
        peak_n = float(np.max(true_n[i : j + 1]))
        yield (
            {**row, **of_frame},
            {
                "largest frame": peak_n,
                "peak_grf_n": peak_n,
                "duration_s": end_s - begin_s,
                "impulse_n_s": float(np.trapezoid(true_n[first : last + 1], t_s[first : last + 1])),
                "cop_x_range_m": float(np.ptp(true_m[i : j + 1][stated])) if stated.any() else 0.0,
            },
        )


def _crossing(t_s: Any, force_n: Any, at: int, level_n: float, way: int) -> tuple[float, int]:
    """Return when the true force passes a level near a frame, and the frame beyond it."""
    while 0 < at < len(force_n) - 1 and force_n[at] > level_n:
        at += way
    while 0 < at < len(force_n) - 1 and force_n[at - way] <= level_n:
        at -= way
    share = (level_n - force_n[at]) / (force_n[at - way] - force_n[at])
    return float(t_s[at] + share * (t_s[at - way] - t_s[at])), at


def make_row(scene: str, figure: str, found: list[tuple[dict[str, Any], dict[str, float]]]) -> str:
    """Return the table row of a figure: errors are estimate minus truth."""
    sigma = SIGMAS[figure]
    pairs = [(row[figure] - true[figure], row[sigma]) for row, true in found if row[sigma]]
    errors, sigmas = np.array(pairs).T
    inside = np.abs(errors) <= 1.96 * sigmas
    return (
        f"| `{scene}` | {figure} | {len(pairs)} of {len(found)} | {np.mean(errors):+.2g} "
        f"| {np.sqrt(np.mean(errors**2)):.2g} | {np.median(sigmas):.2g} "
        f"| {100 * np.mean(inside):.0f} % |"
    )


def main() -> None:
    """Print a table of figures: stances with a sigma, bias, rms error, sigma, coverage."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=DRAWS)
    parser.add_argument("--data", type=Path)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.data or Path(temporary)
        for scene in SCENES:
            found = []
            for seed in range(options.draws):
                path = folder / f"{scene}-{seed}.parquet"
                if not path.exists():
                    simulate(scene, seed, path)
                found += list(compare_stances(path))
            rows += [make_row(scene, figure, found) for figure in SIGMAS]
    print("| scene | figure | stances | bias | rms error | median sigma | within 95 % |")
    print("|---|---|--:|--:|--:|--:|--:|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()

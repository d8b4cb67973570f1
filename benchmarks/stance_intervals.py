"""How often the 95 % intervals of stances hold the truth of emulated feet (docs/method.md).

    python benchmarks/stance_intervals.py [--draws N] [--data DIR]

Built-in scenes, and two loads that are drawn here: `walking` on the insole, and `taps` of 40 to
120 ms on the foot of `standing`. `largest frame` is the largest GRF with the sigma of its frame, as
a peak without regard to noise. Recordings stay in DIR and are used again.

Each recording is also estimated with random gaps of 4 to 150 ms, about one a second, of every other
recording as slots that were not sampled, else as lost frames: `with gaps` are its whole stances
with a gap. There a peak without a sigma is a lower bound, which holds if the truth is above it less
1.96 sigma of its frame.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from devices.arrays import Floats
from devices.flags import FrameFlag
from devices.frames import FrameBatch
from service.cli.main import main as foottile
from service.sessions.stances import compute_stances
from storage.schema import TRUTH_COLUMNS
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter

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
_BOUND = "peak_grf_n, at least"
"""Peaks that are lower bounds: a gap may hide a higher one."""
GAP_S = (0.004, 0.15)
"""Shortest and longest gap; evenly distributed over the logarithm."""
GAPS_EVERY_S = 1.0
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
    run_foottile("simulate", f"--out={path}", *options)


def estimate_with_gaps(path: Path, seed: int, out: Path) -> None:
    """Write a session without the frames in random gaps, estimated again."""
    rng = np.random.default_rng(seed)
    punched = out.with_suffix(".punched.parquet")
    with (
        SealedFileReader(path) as session,
        SealedFileWriter(punched, session.info, session.notes) as writer,
    ):
        first_ns, _ = session.read_span_on_axis_ns()
        at_ns = first_ns + 1e9 * np.cumsum(rng.exponential(GAPS_EVERY_S, 1000))
        end_ns = at_ns + 1e9 * np.exp(rng.uniform(np.log(GAP_S[0]), np.log(GAP_S[1]), len(at_ns)))
        frames = 0
        for batch, truth in session.read_batches(*(column.name for column in TRUTH_COLUMNS)):
            # After the lead, for the tare.
            is_lead = (batch.frame_flags & FrameFlag.LEAD) != 0
            in_gap = (batch.t_ns[:, None] > at_ns) & (batch.t_ns[:, None] < end_ns)
            kept = np.flatnonzero(is_lead | ~in_gap.any(axis=1))
            columns = {
                field.name: getattr(batch, field.name)[kept] for field in dataclasses.fields(batch)
            }
            if seed % 2:  # not sampled: numbers go on
                columns["seq"] = np.arange(frames, frames + len(kept)).astype(np.uint64)
            frames += len(kept)
            writer.append_frames(
                FrameBatch(**columns), {name: values[kept] for name, values in truth.items()}
            )
    run_foottile("estimate", str(punched), f"--out={out}")
    punched.unlink()


def run_foottile(*arguments: str) -> None:
    """Run a command of foottile, which must succeed."""
    sys.argv = ["foottile", *arguments]
    try:
        foottile()
    except SystemExit as ended:
        if ended.code:
            raise


def find_whole_stances(path: Path) -> list[dict[str, Any]]:
    """Find the whole stances of a session."""
    with SealedFileReader(path) as session:
        return [row for row in compute_stances(session).to_pylist() if row["is_whole"]]


def compare_stances(
    path: Path, stances: list[dict[str, Any]]
) -> Iterator[tuple[dict[str, Any], dict[str, float]]]:
    """Yield stances, of all or some frames of a session, with the true figures of all frames."""
    table = pq.read_table(path, columns=list(_NAMES))
    t_ns, grf_n, sigma_n, cop_m, true_n, true_m = (table[name].to_numpy() for name in _NAMES)
    t_s = (t_ns - t_ns[0]) * 1e-9

    def find_edges(stances: list[dict[str, Any]]) -> list[Any]:
        return [np.searchsorted(t_ns, [row["begin_t_ns"], row["end_t_ns"]]) for row in stances]

    edges = find_edges(find_whole_stances(path))
    if not edges:
        return
    # The thresholds of contact are between the forces on either side of its edges.
    on_n = 0.5 * (max(grf_n[i - 1] for i, _ in edges) + min(grf_n[i] for i, _ in edges))
    off_n = 0.5 * (max(grf_n[j + 1] for _, j in edges) + min(grf_n[j] for _, j in edges))
    for row, (i, j) in zip(stances, find_edges(stances), strict=True):
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
    is_bound = figure == _BOUND
    value, sigma = ("peak_grf_n", SIGMAS["largest frame"]) if is_bound else (figure, SIGMAS[figure])
    stated = [
        (row, true)
        for row, true in found
        if (row["peak_sigma_n"] is None if is_bound else row[sigma])
    ]
    if not stated:
        return f"| {scene} | {figure} | 0 of {len(found)} | | | | |"
    pairs = [(row[value] - true[value], row[sigma]) for row, true in stated]
    errors, sigmas = np.array(pairs).T
    inside = (errors if is_bound else np.abs(errors)) <= 1.96 * sigmas
    return (
        f"| {scene} | {figure} | {len(pairs)} of {len(found)} | {np.mean(errors):+.2g} "
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
            found, gapped, split = [], [], []
            for seed in range(options.draws):
                path = folder / f"{scene}-{seed}.parquet"
                if not path.exists():
                    simulate(scene, seed, path)
                whole = find_whole_stances(path)
                found += list(compare_stances(path, whole))
                other = folder / f"{scene}-{seed}-gaps.parquet"
                if not other.exists():
                    estimate_with_gaps(path, seed, other)
                after = find_whole_stances(other)
                gapped += list(compare_stances(path, [row for row in after if row["gap_s"]]))
                split.append((len(whole), len(after)))
            rows += [make_row(f"`{scene}`", figure, found) for figure in SIGMAS]
            rows += [
                make_row(f"`{scene}` with gaps", figure, gapped) for figure in (*SIGMAS, _BOUND)
            ]
            print(f"{scene}: whole without and with gaps: {np.sum(split, axis=0)}")
    print("| scene | figure | stances | bias | rms error | median sigma | within 95 % |")
    print("|---|---|--:|--:|--:|--:|--:|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()

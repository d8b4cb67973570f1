"""How often the 95 % intervals of stances hold the truth of emulated feet (docs/method.md).

python benchmarks/stance_intervals.py
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from service.cli.main import main as foottile
from service.sessions.stances import compute_stances
from storage.sessions.reader import SealedFileReader

SCENES = ("poppy", "rolling", "mud")
DRAWS = 4
SECONDS = 12
FIGURES = ("duration_s", "impulse_n_s", "cop_x_range_m")
SIGMAS = ("duration_sigma_s", "impulse_sigma_n_s", "cop_x_range_sigma_m")
_NAMES = ("t_ns", "grf_n", "cop_x_m", "true_grf_n", "true_cop_x_m")


def simulate(scene: str, seed: int, path: Path) -> None:
    """Write a session of other parts and other noise."""
    options = [f"--seed={seed}", f"--parts-seed={seed}", f"--seconds={SECONDS}", "--truth"]
    sys.argv = ["foottile", "simulate", f"--scene={scene}", f"--out={path}", *options]
    try:
        foottile()
    except SystemExit as ended:
        if ended.code:
            raise


def judged(path: Path) -> Iterator[tuple[dict[str, Any], dict[str, float]]]:
    """Yield each whole stance of a session with its true figures."""
    table = pq.read_table(path, columns=list(_NAMES))
    t_ns, grf_n, cop_m, true_n, true_m = (table[name].to_numpy() for name in _NAMES)
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
        yield (
            row,
            {
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


def main() -> None:
    """Print for each scene and figure: stances, those within the interval, error and sigma."""
    lines = []
    for scene in SCENES:
        found = []
        with tempfile.TemporaryDirectory() as folder:
            for seed in range(DRAWS):
                path = Path(folder) / f"{scene}{seed}.parquet"
                simulate(scene, seed, path)
                found += list(judged(path))
        for figure, sigma in zip(FIGURES, SIGMAS, strict=True):
            pairs = [(row[figure] - true[figure], row[sigma]) for row, true in found if row[sigma]]
            errors, sigmas = np.array(pairs).T
            inside = int((np.abs(errors) <= 1.96 * sigmas).sum())
            error, half = np.median(np.abs(errors)), np.median(sigmas)
            lines.append(
                f"{scene}, {figure}: {inside} of {len(pairs)}, error {error:.2g}, "
                f"sigma {half:.2g} (medians), not stated {len(found) - len(pairs)}"
            )
    print("\n".join(lines))


if __name__ == "__main__":
    main()

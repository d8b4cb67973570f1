"""Are the intervals of `foottile compare` true? Lags, drifts, offsets, scales, injected and found.

    python benchmarks/compare_alignment.py --data DIR [--draws N] [--feet] [--out FILE]

Recorded loads of DIR are what the foot and the reference both see. Each draw gives the reference
another clock, offset, scale and noise, aligns the two, and asks whether each 95 % interval has what
was injected. Ours is the load with noise that remembers, in part growing with the force; with
`--feet` it is what the estimator makes of the load on emulated domes, with errors of its own: every
draw has other domes, each pressed on the emulated bench first (some 5 s of CPU each).
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from ladders import CASES
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter

from devices.arrays import Floats
from devices.errors import ComparisonError
from devices.scene.scene_file import load_scene
from service.offline.calibration_lookup import find_calibration
from service.offline.compare.alignment import ReferenceAlignment, align_signals
from service.offline.compare.signals import ForceSignal
from storage.formats.load_trace import read_load_to_emulate
from studies.benchmark.draws import compute_estimates, record_with_calibration

MARK = "<!-- tables -->"
PARAMETERS = ("lag_s", "drift_ppm", "offset_n", "scale")
UNITS = ((1e3, " ms"), (1.0, " ppm"), (1.0, " N"), (1.0, ""))
OURS_HZ = 447.0
ON_FEET = ("insole, walking, left", "standing, squat jumps")


@dataclass(frozen=True)
class Load:
    """A recorded load; of a long one so many seconds are drawn from anywhere."""

    name: str
    file: str
    scale: float
    seconds: float | None


LOADS = (
    Load("walking", "insole_walk_left.csv", 0.05, 20.0),
    Load("squat jumps", "squat_jump_plate1.csv", 0.06, None),
)


@dataclass(frozen=True)
class Injected:
    """What a reference is to ours, the lag at `mid_t_s`; `ours = scale (reference - offset_n)`."""

    lag_s: float
    drift_ppm: float
    offset_n: float
    scale: float
    at_s: float

    def of(self, found: ReferenceAlignment) -> tuple[float, ...]:
        """Of each parameter, what should have been found."""
        lag_s = self.lag_s + 1e-6 * self.drift_ppm * (found.mid_t_s - self.at_s)
        return lag_s, self.drift_ppm, self.offset_n, self.scale


def remembering(rng: np.random.Generator, n: int, hz: float, memory_s: float) -> Floats:
    """Noise (n,) of unit variance that forgets exponentially."""
    kept = np.exp(-1.0 / (memory_s * hz))
    fresh = np.sqrt(1.0 - kept**2) * rng.normal(size=n)
    return np.asarray(lfilter([1.0], [1.0, -kept], fresh))


def noisy(rng: np.random.Generator, t_s: Floats, force_n: Floats) -> ForceSignal:
    """Ours: 0.1 N white, 0.1 N over 50 ms, and 2 % of the force over 0.3 s."""
    n = len(t_s)
    noise_n = 0.1 * rng.normal(size=n) + 0.1 * remembering(rng, n, OURS_HZ, 0.05)
    noise_n += 0.02 * force_n * remembering(rng, n, OURS_HZ, 0.3)
    return ForceSignal(t_s, force_n + noise_n)


def referred(
    rng: np.random.Generator, t_s: Floats, force_n: Floats
) -> tuple[ForceSignal, Injected]:
    """A reference that has seen most of a force.

    500 or 1000 Hz; 0.3 N white, 0.2 N over 10 ms, and where the force changes most (2 %) ringing
    with heavy tails (Student's t with two degrees of freedom, 0.5 N).
    """
    begin_s, end_s = float(t_s[0]), float(t_s[-1])
    spare_s = 0.1 * (end_s - begin_s)
    hz = float(rng.choice([500.0, 1000.0]))
    at_s = np.arange(begin_s + rng.uniform(0.0, spare_s), end_s - rng.uniform(0.0, spare_s), 1 / hz)
    true = Injected(
        lag_s=float(rng.uniform(-5.0, 5.0)),
        drift_ppm=float(rng.uniform(-100.0, 100.0)),
        offset_n=float(rng.uniform(-2.0, 2.0)),
        scale=float(rng.uniform(0.9, 1.1)),
        at_s=0.5 * (begin_s + end_s),
    )
    seen_n = np.asarray(PchipInterpolator(t_s, force_n)(at_s))
    rate = np.abs(np.gradient(seen_n, at_s))
    read_n = true.offset_n + seen_n / true.scale + 0.3 * rng.normal(size=len(at_s))
    read_n += 0.2 * remembering(rng, len(at_s), hz, 0.01)
    read_n += 0.5 * (rate > np.percentile(rate, 98)) * rng.standard_t(2, size=len(at_s))
    clock_s = at_s + true.lag_s + 1e-6 * true.drift_ppm * (at_s - true.at_s)
    return ForceSignal(clock_s, read_n), true


Draws = Iterator[tuple[ForceSignal, ForceSignal, Injected]]


def drawn_alone(load: Load, data: Path, draws: int) -> Draws:
    """Ours and reference from a recorded load, without any estimator."""
    trace = read_load_to_emulate(data / load.file)
    total_n = trace.fz_n if trace.cells_n is None else trace.cells_n.sum(axis=1)
    assert total_n is not None
    force = PchipInterpolator(trace.time_s, load.scale * total_n)
    first_s, last_s = float(trace.time_s[0]), float(trace.time_s[-1])
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        length_s = load.seconds or last_s - first_s
        begin_s = rng.uniform(first_s, last_s - length_s)
        t_s = np.arange(begin_s, begin_s + length_s, 1.0 / OURS_HZ)
        force_n = np.asarray(force(t_s))
        yield noisy(rng, t_s, force_n), *referred(rng, t_s, force_n)


def drawn_on_feet(name: str, data: Path, draws: int) -> Draws:
    """Ours by the estimator on emulated domes: each draw has another foot with its own bench."""
    (case,) = (case for case in CASES if case.name == name)
    scene = load_scene(case.scene)
    serials = [tile.serial for tile in scene.tile if not tile.reference]
    wanted = ("t_ns", "grf_n", "grf_sigma_n", "true_grf_n")
    for draw in range(draws):
        calibration = find_calibration(scene.calibration, serials, parts_seed=draw)
        foot = replace(case.foot(data), parts_seed=draw)
        recording, _ = record_with_calibration(scene, case.seconds, draw, calibration, foot)
        columns = compute_estimates(recording, tuple(scene.models), 100.0, wanted)
        known = np.isfinite(columns["grf_n"])
        t_s = ((columns["t_ns"] - columns["t_ns"][0]) * 1e-9)[known]
        ours = ForceSignal(t_s, columns["grf_n"][known], columns["grf_sigma_n"][known])
        rng = np.random.default_rng(draw)
        yield ours, *referred(rng, t_s, columns["true_grf_n"][known])


def row(name: str, draws: Draws) -> str:
    """A line of the table: of each parameter coverage, median standard error, and mean error."""
    began_s = time.process_time()
    hits = np.zeros(len(PARAMETERS))
    sigmas: list[list[float]] = []
    errors: list[Floats] = []
    refused: Counter[str] = Counter()
    for ours, reference, true in draws:
        try:
            found = align_signals(ours, reference)
        except ComparisonError as error:
            refused[error.what.partition(":")[0]] += 1
            continue
        estimates = [getattr(found, parameter) for parameter in PARAMETERS]
        for i, (one, value) in enumerate(zip(estimates, true.of(found), strict=True)):
            low, high = one.interval_95
            hits[i] += low <= value <= high
        errors.append(np.array([one.value for one in estimates]) - np.array(true.of(found)))
        sigmas.append([math.hypot(one.sigma, one.repeating_sigma) for one in estimates])
    count = len(sigmas)
    cells = [
        f"{100.0 * hit / count:.1f} % ({factor * sigma:.2g}, {factor * error:+.2g}{unit})"
        for hit, sigma, error, (factor, unit) in zip(
            hits, np.median(sigmas, axis=0), np.mean(errors, axis=0), UNITS, strict=True
        )
    ]
    why = ", ".join(f"{n} {what}" for what, n in refused.items()) or "none"
    each_s = (time.process_time() - began_s) / (count + refused.total())
    return f"| {name} | {count} | {' | '.join(cells)} | {why} | {each_s:.2f} |"


def tables(data: Path, draws: int, *, feet: bool) -> Iterator[str]:
    """The table, line by line."""
    kind = "emulated feet" if feet else "alignment alone"
    yield from ("", f"### {kind}", "")
    yield "| load | draws | lag | drift | offset | scale | refused | CPU s a draw |"
    yield "|---|--:|--:|--:|--:|--:|---|--:|"
    if feet:
        for name in ON_FEET:
            yield row(name, drawn_on_feet(name, data, draws))
    else:
        for load in LOADS:
            yield row(load.name, drawn_alone(load, data, draws))


def main() -> None:
    """See the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--feet", action="store_true")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    lines = []
    for line in tables(asked.data, asked.draws, feet=asked.feet):
        lines.append(line)
        print(line, flush=True)
    if asked.out is not None:
        before = asked.out.read_text("utf-8")
        head = before if asked.feet else before.partition(MARK)[0] + MARK  # feet come last
        asked.out.write_text(head.rstrip("\n") + "\n" + "\n".join(lines) + "\n", "utf-8")


if __name__ == "__main__":
    main()

"""Error of estimates after a tare between two steps (docs/method.md, Tare).

    python benchmarks/flight_tare.py [--tares N]

An emulated foot steps on, and is tared at N instants from its newest unloaded quarter second, as by
hand. The next 12 s are estimated with that tare as it is read, without the recovery of the rubber,
and with the tare of the lead. Every estimate begins at the instant of the tare, as a live one does.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from devices.arrays import Bools, Floats
from devices.chips.pressure_chips import Compensation
from devices.errors import TareError
from devices.frames import ArrayInfo, FrameBatch
from service.cli.main import main as foottile
from service.estimation import LIVE_LAG_MS
from service.estimation.calibration import Calibration
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.plan import make_plan
from service.estimation.tare.automatic import HISTORY_NS, compute_newest_unloaded_tare
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import TareFrames, compute_recording_tare
from service.estimation.tare_recovery import remove_recovery
from storage.sessions.reader import SealedFileReader

TARES = 36
BEGIN_S, STEP_S, AFTER_S = 12.0, 1.37, 12.0
"""First tare, distance of two, and length of the estimates after each."""
SETTLED_FRAMES = 90
"""Frames without load around a frame that counts as flight."""
STEPS_S = 3.02
"""Length of the three steps of `mud`, which this benchmark repeats."""


@dataclass(frozen=True)
class Walk:
    """Recorded steps with their true force."""

    info: ArrayInfo
    calibration: Calibration
    frames: FrameBatch
    true_grf_n: Floats
    models: tuple[str, ...]


def _simulate(*options: str) -> None:
    sys.argv = ["foottile", "simulate", "--truth", *options]
    try:
        with contextlib.redirect_stdout(None):
            foottile()
    except SystemExit as ended:
        if ended.code:
            raise


def _repeat_steps(folder: Path, seconds: float) -> Path:
    """Write a load that repeats the steps of `mud`."""
    _simulate("--scene=mud", "--seconds=4.1", f"--out={folder / 'steps.parquet'}")
    names = ("t_ns", "true_grf_n", "true_cop_x_m", "true_cop_y_m")
    columns = _read_columns(folder / "steps.parquet", names)
    t_s = (columns["t_ns"] - columns["t_ns"][0]) * 1e-9 - 1.0
    within = (t_s >= 0.0) & (t_s < STEPS_S - 0.02)
    rows = np.column_stack([t_s[within], *(np.nan_to_num(columns[n][within]) for n in names[1:])])
    repeated = [
        rows + np.array([STEPS_S * i, 0.0, 0.0, 0.0]) for i in range(int(seconds / STEPS_S))
    ]
    path = folder / "load.csv"
    head = "time_s,grf_n,cop_x_m,cop_y_m"
    np.savetxt(path, np.vstack(repeated), delimiter=",", header=head, comments="")
    return path


def _read_columns(path: Path, names: tuple[str, ...]) -> dict[str, Floats]:
    with SealedFileReader(path) as session:
        pieces = list(session.read_quantities(*names))
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


def record_walk(scene: str, folder: Path, seconds: float) -> Walk:
    """Record an emulated foot of a scene."""
    path = folder / f"{scene}.parquet"
    load = [f"--load={_repeat_steps(folder, seconds)}", "--sign=+"] if scene == "mud" else []
    length = [] if load else [f"--seconds={seconds}"]
    _simulate(f"--scene={scene}", *load, *length, f"--out={path}")
    with SealedFileReader(path) as session:
        frames = FrameBatch.concatenate([frames for frames, _ in session.read_batches()])
        calibration = Calibration.model_validate(session.notes["calibration"])
        info = session.info
    true_grf_n = _read_columns(path, ("true_grf_n",))["true_grf_n"]
    return Walk(info, calibration, frames, true_grf_n, info.models)


def _estimate_grf(walk: Walk, tare: Tare, first: int, end: int) -> tuple[Floats, Floats]:
    """Return GRF and its sigma of the frames `first` to `end`."""
    plan = make_plan(walk.info, walk.calibration, tare, models=walk.models, lag_ms=LIVE_LAG_MS)
    estimator = ModelEstimator(plan)
    pieces = [estimator.process_frames(walk.frames.slice_rows(first, end)), estimator.finish()]
    due = [piece for piece in pieces if piece is not None]
    return (
        np.concatenate([piece.grf_n for piece in due]),
        np.concatenate([piece.grf_sigma_n for piece in due]),
    )


def _judge(error_n: Floats, sigma_n: Floats, is_flight: Bools) -> Floats:
    """Return mean error and coverage in flight, mean and RMS error and coverage in stance."""
    figures: list[float] = []
    for rows in (is_flight, ~is_flight):
        known = rows & np.isfinite(error_n)
        covered = np.abs(error_n[known]) < 1.96 * sigma_n[known]
        rms_n = np.sqrt(np.mean(error_n[known] ** 2))
        figures += [float(np.mean(error_n[known])), float(rms_n), float(covered.mean())]
    return np.array(figures)


def tare_between_steps(walk: Walk, tares: int) -> Mapping[str, Floats]:
    """Return the figures of `_judge` of each tare that succeeds, by the kind of tare, (n, 6)."""
    compensation, serials = Compensation(walk.info.tiles), walk.info.serials
    lead = compute_recording_tare(walk.frames, compensation, walk.calibration, serials)
    bears = np.array([not tile.reference for tile in walk.info.tiles])
    t_ns = walk.frames.t_ns
    found: dict[str, list[Floats]] = {"as read": [], "without recovery": [], "lead": []}
    for at_s in BEGIN_S + STEP_S * np.arange(tares):
        end = int(np.searchsorted(t_ns, t_ns[0] + at_s * 1e9))
        first = int(np.searchsorted(t_ns, t_ns[end] - HISTORY_NS))
        recent = walk.frames.slice_rows(first, end)
        seen = TareFrames(recent, compensation, walk.calibration, serials)
        try:
            read = compute_newest_unloaded_tare(seen, present=lead, is_load_bearing=bears)
        except TareError:
            continue
        recovered = remove_recovery(
            read, recent, info=walk.info, calibration=walk.calibration, models=walk.models
        )
        last = int(np.searchsorted(t_ns, t_ns[end] + AFTER_S * 1e9))
        true_n = walk.true_grf_n[end:last]
        unloaded = (true_n < 0.01).astype(int)
        is_flight = np.convolve(unloaded, np.ones(SETTLED_FRAMES), "same") >= SETTLED_FRAMES
        is_stance = unloaded == 0
        judged = is_flight | is_stance
        for kind, tare in zip(found, (read, recovered, lead), strict=True):
            grf_n, sigma_n = _estimate_grf(walk, tare, end, last)
            error_n = grf_n - true_n
            found[kind].append(_judge(error_n[judged], sigma_n[judged], is_flight[judged]))
    return {kind: np.array(rows) for kind, rows in found.items()}


def main() -> None:
    """Print a row for each scene and kind of tare."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--tares", type=int, default=TARES)
    asked: Any = parser.parse_args()
    seconds = BEGIN_S + STEP_S * asked.tares + AFTER_S + 2.0
    print("| scene | tare | n | flight, N | within 95 % | stance, N | RMS, N | within 95 % |")
    print("|---|---|--:|--:|--:|--:|--:|--:|")
    with tempfile.TemporaryDirectory() as folder:
        for scene in ("mud", "rolling"):
            walk = record_walk(scene, Path(folder), seconds)
            for kind, rows in tare_between_steps(walk, asked.tares).items():
                flight, _, in_flight, stance, rms, in_stance = rows.mean(axis=0)
                print(
                    f"| {scene} | {kind} | {len(rows)} | {flight:+.2f} | {in_flight:.0%} "
                    f"| {stance:+.2f} | {rms:.2f} | {in_stance:.0%} |"
                )


if __name__ == "__main__":
    main()

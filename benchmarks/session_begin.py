"""Are the first seconds of a session as good as its middle, if it begins under load?

    python benchmarks/session_begin.py [--sessions 40] [--without-history] [--seed 1]
        [--load FILE.csv --load-scale 0.05] [--recordings FOLDER]

Each scene walks, hops or stands on either chip, over and over; sessions begin at random instants,
and are sealed from the journal as a server does. Of the GRF less the truth: the share of frames
within 1.96 sigma, the mean error of a session without its sign ("bias"), and the stated sigma; in
the first five seconds, and in as many of its middle. `--without-history`: the stream begins with
the session, so that no frame before it is known; then also the share of frames that say so.

The scene `insole` needs a load. `grid` and `indentation` are left out: their models have no memory.
`--recordings` keeps the emulated frames, which take most of the time, for another run.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from side_by_side import note, table

from devices.arrays import Floats
from devices.chips.pressure_chips import Compensation
from devices.clock import Clock
from devices.emulation.ground.load_trace import TileLoad
from devices.emulation.world import World
from devices.flags import EstimateFlag
from devices.frames import FrameBatch
from devices.scene.scene_file import Scene, load_scene
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import compute_recording_tare
from service.offline.calibration_lookup import find_calibration
from service.offline.simulation import SimulationOptions, run_simulation
from service.rig.emulated_foot import EmulatedFoot
from service.sessions.estimate_stream import EstimateOptions, EstimateStream
from service.sessions.inputs import SessionInputs
from service.sessions.parts import compute_warm_up
from service.sessions.sealing import write_sealed_files
from storage.formats.load_trace import read_load_to_emulate
from storage.journal.journal import Journal
from storage.sessions.folder import FRAMES_NAME, Ledger, Part, PartLedger, Session
from storage.sessions.reader import SealedFileReader

SCENES = ("standing", "rolling", "poppy", "mud", "insole")
CHIPS = ("mpl115a2", "bmp581")
EARLIEST_S, LATEST_S, RECORDED_S = 22.0, 36.0, 52.0
BEGIN_S, MIDDLE_S, END_S = 5.0, 7.0, 12.0
"""The first seconds of a session; begin and end of its middle, and its own end 2 s later."""
UNLOADED_MAX_N = 0.2
"""Largest GRF of a foot in the air: contact ends about there."""
MESSAGE_FRAMES = 100


class RepeatedFoot(EmulatedFoot):
    """Foot whose programme or load begins again where it ends."""

    def make_world(
        self,
        scene: Scene,
        clock: Clock,
        tile_load: TileLoad | None,
        *,
        is_repeated: bool = False,
        in_real_time: bool = False,
    ) -> World:
        """See `EmulatedFoot`."""
        return super().make_world(
            scene, clock, tile_load, is_repeated=not is_repeated, in_real_time=in_real_time
        )


@dataclass(frozen=True)
class Recorded:
    """Stream of a scene in a journal, with what was true."""

    journal: Journal
    t_s: Floats
    true_grf_n: Floats
    calibration: Calibration
    tare: Tare
    settling_s: float


@dataclass(frozen=True)
class Outcome:
    """Errors in one session, at its begin and in its middle."""

    covered: tuple[float, float]
    bias_n: tuple[float, float]
    sigma_n: tuple[float, float]
    flagged: float
    first_error_n: float
    first_sigma_n: float


def record(scene_name: str, chip: str, foot: EmulatedFoot, folder: Path) -> Recorded:
    """Emulate a scene, unless its recording is kept, and write its journal."""
    scene, path = load_scene(scene_name, chip), folder / f"{scene_name}-{chip}.parquet"
    if not path.exists():
        note(f"{scene_name}, {chip}")
        emulation = SimulationOptions(scene, RECORDED_S, with_truth=True, foot=foot)
        run_simulation(emulation, path, None)
    serials = [tile.serial for tile in scene.tile if not tile.reference]
    calibration = find_calibration(
        scene.calibration, serials, chips={tile.serial: tile.chip for tile in scene.tile}
    )
    with SealedFileReader(path) as reader:
        pieces = list(reader.read_batches("true_grf_n"))
        info = reader.info
    frames = FrameBatch.concatenate([batch for batch, _ in pieces])
    journal = Journal(folder / f"{scene_name}-{chip}.journal", info)
    if not journal.stored:
        for begin in range(0, len(frames), MESSAGE_FRAMES):
            end = min(begin + MESSAGE_FRAMES, len(frames))
            journal.append_new_frames(frames.slice_rows(begin, end))
        journal.sync()
    lead = frames.slice_rows(0, int(np.searchsorted(frames.t_ns, frames.t_ns[0] + 2 * 10**9)))
    tare = compute_recording_tare(lead, Compensation(info.tiles), calibration, info.serials)
    options = EstimateOptions(calibration, info.models, 0.0)
    return Recorded(
        journal,
        (frames.t_ns - frames.t_ns[0]) * 1e-9,
        np.concatenate([columns["true_grf_n"] for _, columns in pieces]).astype(np.float64),
        calibration,
        tare,
        EstimateStream(info, options).settling_time_s,
    )


def seal(recorded: Recorded, begin_s: float, folder: Path, *, has_history: bool) -> Outcome:
    """Seal the session that begins at an instant, and compare it with the truth."""
    first, end = np.searchsorted(recorded.t_s, (begin_s, begin_s + END_S + 2.0)).tolist()
    info = recorded.journal.info
    part = Part(stream_id=info.stream_id, seq_first=first, seq_last=end - 1)
    unloaded = np.flatnonzero(recorded.true_grf_n[:first] < UNLOADED_MAX_N)
    unloaded_seq = int(unloaded[-1]) if len(unloaded) else None
    warm_up = (
        compute_warm_up(info, first, recorded.settling_s, unloaded_seq) if has_history else None
    )
    session = Session(
        id="20200101T000000Z-000000",
        name="begin",
        node=info.node,
        state="sealing",
        started_t_ns=0,
        parts=(part,),
        warm_up=warm_up,
        scene=info.scene,
        calibration=recorded.calibration.model_dump(mode="json"),
    )
    inputs = SessionInputs(
        session=session,
        info=info,
        journals={info.stream_id: recorded.journal},
        calibration=recorded.calibration,
        problem=None,
        tares=(recorded.tare,),
        notes={},
    )
    counted = PartLedger(
        **part.model_dump(), recorded=end - first, lost={}, pending=0, max_lost_tail_frames=0
    )
    ledger = Ledger(complete=True, lossy=False, parts=(counted,), missed_slots=0)
    sealed = write_sealed_files(inputs, folder, ledger)
    assert sealed.problem is None, sealed.problem
    return compare(folder / FRAMES_NAME, recorded.true_grf_n[first:end])


def compare(path: Path, true_grf_n: Floats) -> Outcome:
    """Compare a sealed session with the truth of its frames."""
    with SealedFileReader(path) as reader:
        pieces = list(reader.read_quantities("t_ns", "grf_n", "grf_sigma_n", "estimate_flags"))
    found = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    t_s = (found["t_ns"] - found["t_ns"][0]) * 1e-9
    error_n = found["grf_n"].astype(np.float64) - true_grf_n
    sigma_n = found["grf_sigma_n"].astype(np.float64)
    spans = [t_s < BEGIN_S, (t_s >= MIDDLE_S) & (t_s < END_S)]
    spans = [span & np.isfinite(error_n) for span in spans]
    unknown = (found["estimate_flags"] & np.uint16(EstimateFlag.HISTORY_UNKNOWN)) != 0
    first = int(np.flatnonzero(spans[0])[0])

    def both(values: Floats) -> tuple[float, float]:
        begin, middle = (float(values[span].mean()) for span in spans)
        return begin, middle

    errors_n = both(error_n)
    return Outcome(
        both((np.abs(error_n) <= 1.96 * sigma_n).astype(np.float64)),
        (abs(errors_n[0]), abs(errors_n[1])),
        both(sigma_n),
        float(unknown[spans[0]].mean()),
        float(error_n[first]),
        float(sigma_n[first]),
    )


def summarize(name: str, outcomes: list[Outcome]) -> list[str]:
    """Return the row of some sessions."""

    def mean(field: str) -> Floats:
        return np.asarray(np.mean([getattr(each, field) for each in outcomes], axis=0))

    covered, bias_n, sigma_n = mean("covered"), mean("bias_n"), mean("sigma_n")
    worst = max(outcomes, key=lambda each: abs(each.first_error_n))
    return [
        name,
        str(len(outcomes)),
        f"{100 * covered[0]:.1f} / {100 * covered[1]:.1f}",
        f"{bias_n[0]:.3f} / {bias_n[1]:.3f}",
        f"{bias_n[0] / bias_n[1]:.2f}",
        f"{sigma_n[0]:.3f} / {sigma_n[1]:.3f}",
        f"{sigma_n[0] / sigma_n[1]:.2f}",
        f"{worst.first_error_n:+.2f} ± {1.96 * worst.first_sigma_n:.2f}",
        f"{100 * float(mean('flagged')):.0f}",
    ]


def run(args: argparse.Namespace, folder: Path) -> Iterator[list[str]]:
    """Yield the table's rows."""
    rng = np.random.default_rng(args.seed)
    scenes = [name for name in SCENES if name != "insole" or args.load is not None]
    kinds = [(scene, chip) for scene in scenes for chip in CHIPS]
    shares = np.diff(np.linspace(0, args.sessions, len(kinds) + 1).round().astype(int)).tolist()
    everything: list[Outcome] = []
    for (scene, chip), count in zip(kinds, shares, strict=True):
        foot: EmulatedFoot = RepeatedFoot()
        if scene == "insole":
            foot = replace(foot, load=read_load_to_emulate(args.load), load_scale=args.load_scale)
        recorded = record(scene, chip, foot, folder)
        begins_s = np.sort(rng.uniform(EARLIEST_S, LATEST_S, count)).tolist()
        with tempfile.TemporaryDirectory() as work:
            outcomes = [
                seal(recorded, begin_s, Path(work), has_history=not args.without_history)
                for begin_s in begins_s
            ]
        everything += outcomes
        yield summarize(f"{scene}, {chip}", outcomes)
    yield summarize("all", everything)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sessions", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--without-history", action="store_true")
    parser.add_argument("--load", type=Path)
    parser.add_argument("--load-scale", type=float, default=0.05)
    parser.add_argument("--recordings", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) if args.recordings is None else args.recordings
        folder.mkdir(parents=True, exist_ok=True)
        rows = list(run(args, folder))
    head = ("first 5 s / middle", "sessions", "within 1.96 sigma, %", "bias, N", "times",
            "sigma, N", "times", "largest error of a first frame, N", "flagged, %")  # fmt: skip
    print("\n".join(table(head, rows)))


if __name__ == "__main__":
    main()

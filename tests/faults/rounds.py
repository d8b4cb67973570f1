"""Rounds of faults: real processes, killed, cut off and without power, and the ledger of each.

    python tests/faults/rounds.py --rounds 200 --seed 1 --jobs 2 --out docs/results/faults.md

Each round has its own seed (the first is --seed), which draws its faults, its own processes, ports
and folders; `--only SEED` plays one again. Not everything in it is drawn: the machine's scheduling
is not, so a seed that failed may have to be played more than once.
"""

# ruff: noqa: E402, T201  # imports come after the path is set; a command prints

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx

ROOT = Path(__file__).resolve().parents[2]
if str(ROOT) not in sys.path:  # run as a script
    sys.path.insert(0, str(ROOT))

from tests.faults.alone import Alone
from tests.faults.checks import findings, summary_of
from tests.faults.machines import RoundError
from tests.faults.stage import Stage
from tests.faults.stories import Story, draw_story

ROUND_S = 600.0
"""A round that takes longer is ended and has failed."""
_INTERRUPTED = 130


@dataclass
class Result:
    """One round."""

    seed: int
    faults: str
    findings: list[str]
    ledger: dict[str, Any] = field(default_factory=dict)
    """Of its session; of all of them, if it became several."""
    times: dict[str, float] = field(default_factory=dict)
    acknowledged: int = 0
    folder: str = ""
    """Where its files are, if it failed."""

    def add(self, ledger: dict[str, Any]) -> None:
        """Count another session."""
        self.ledger = {
            "lossy": self.ledger.get("lossy", False) or ledger.get("lossy", False),
            "parts": [*self.ledger.get("parts", ()), *ledger.get("parts", ())],
        }

    @property
    def verdict(self) -> str:
        """In a word."""
        return "failed" if self.findings else "good"

    @property
    def line(self) -> str:
        """For the terminal."""
        seconds = sum(self.times.values())
        kind = "lossy" if self.ledger.get("lossy") else "complete"
        return (
            f"{self.seed:6d}  {self.verdict:6s}  {kind:8s} {seconds:5.1f} s  {self.faults}: "
            f"{summary_of(self.ledger)}"
        )


def play(story: Story, folder: Path) -> Result:
    """Play one round; its folder stays only if it failed.

    Args:
        story: what happens.
        folder: for its files; must not be there yet.
    """
    folder.mkdir(parents=True)
    result = Result(story.seed, story.title, [])
    with (Alone if story.alone else Stage)(story, folder) as stage:
        try:
            for facts in stage.play():
                result.findings += findings(facts)
                result.add(facts.ledger)
        except (RoundError, httpx.HTTPError) as error:
            result.findings = [f"{type(error).__name__}: {error}"]
        result.times = stage.times
        acknowledged = stage.witness.acknowledged().values()
        result.acknowledged = sum(len(numbers) for numbers in acknowledged)
        stage.write_down()
        if result.findings and story.small_disk_of:  # it is gone when it is unmounted
            shutil.copytree(folder / "small", folder / "small-disk", dirs_exist_ok=True)
    if result.findings:
        result.folder = str(folder)
    else:
        shutil.rmtree(folder)
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """The command: 0 if every round was good, else 1."""
    options = _parser().parse_args(arguments)
    if options.only is not None:
        return _play_one(options)
    begin_s = time.monotonic()
    seeds = range(options.seed, options.seed + options.rounds)
    work = Path(tempfile.mkdtemp(prefix="foottile-rounds-"))
    results = []
    print("  seed  verdict  ledger    time    faults: recorded/lost/pending/tail of each part")
    with ThreadPoolExecutor(options.jobs) as pool, _ended_together() as running:
        for result in pool.map(
            lambda seed: _in_a_process(seed, work, running, options.no_mount), seeds
        ):
            results.append(result)
            print(result.line, flush=True)
            for finding in result.findings:
                print(f"        {finding}", flush=True)
            if result.folder:
                print(f"        kept in {result.folder}; again: {_again(result.seed)}", flush=True)
    with suppress(OSError):
        work.rmdir()
    lines = list(_summary(results, time.monotonic() - begin_s))
    print("", *lines, sep="\n")
    if options.out is not None:
        options.out.write_text("\n".join(_report(results, lines, options)) + "\n")
    return 1 if any(result.findings for result in results) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1, help="of the first round")
    parser.add_argument("--jobs", type=int, default=1, help="rounds side by side")
    parser.add_argument("--out", type=Path, help="write a report in markdown")
    parser.add_argument("--only", type=int, metavar="SEED", help="play this round only")
    parser.add_argument("--no-mount", action="store_true", help="fill no disks")
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true", help=argparse.SUPPRESS)
    return parser


def _play_one(options: argparse.Namespace) -> int:
    may_mount = os.geteuid() == 0 and not options.no_mount
    story = draw_story(options.only, may_mount=may_mount)
    folder = options.folder or Path(tempfile.mkdtemp(prefix="foottile-round-")) / "round"
    result = play(story, folder)
    if options.json:
        print(json.dumps(asdict(result)))
    else:
        print(story)
        print(result.line)
        print("\n".join(result.findings))
        print({step: round(seconds, 2) for step, seconds in result.times.items()})
        if result.folder:
            print(f"kept in {result.folder}")
    return 1 if result.findings else 0


@contextmanager
def _ended_together() -> Iterator[set[subprocess.Popen[str]]]:
    """Rounds that are being played; Ctrl-C ends them, too, and begins no others."""
    running: set[subprocess.Popen[str]] = set()
    try:
        yield running
    except KeyboardInterrupt:
        for process in list(running):
            process.send_signal(signal.SIGINT)
        print("ended", flush=True)
        os._exit(_INTERRUPTED)


def _in_a_process(
    seed: int, work: Path, running: set[subprocess.Popen[str]], no_mount: bool
) -> Result:
    """One round in a process group of its own, bounded in time."""
    folder = work / f"round-{seed}"
    command = [sys.executable, __file__, "--only", str(seed), "--folder", str(folder), "--json"]
    process = subprocess.Popen(
        command + (["--no-mount"] if no_mount else []),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    running.add(process)
    try:
        out, err = process.communicate(timeout=ROUND_S)
        return Result(**json.loads(out.splitlines()[-1]))
    except subprocess.TimeoutExpired:
        # It ends what it has started when it is asked to.
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=30.0)
        process.kill()
        return Result(seed, "?", [f"not finished within {ROUND_S:g} s"], folder=str(folder))
    except (IndexError, ValueError):
        return Result(seed, "?", [f"the harness failed: {err[-3000:]}"], folder=str(folder))
    finally:
        running.discard(process)


def _again(seed: int) -> str:
    return f"python tests/faults/rounds.py --only {seed}"


# --- what is said of all --------------------------------------------------------------------------


def _summary(results: list[Result], seconds: float) -> Iterator[str]:
    bad = [result for result in results if result.findings]
    parts = [part for result in results for part in result.ledger.get("parts", ())]
    lossy = sum(bool(result.ledger.get("lossy")) for result in results)
    kinds = Counter(
        kind for result in results for kind in result.faults.removeprefix("alone: ").split(", ")
    )
    yield f"{len(results)} rounds in {seconds / 60:.1f} min: {len(results) - len(bad)} good"
    if bad:
        yield "failed: " + ", ".join(str(result.seed) for result in bad)
    yield (
        f"frames: {sum(result.acknowledged for result in results)} acknowledged, "
        f"{sum(part['recorded'] for part in parts)} sealed, "
        f"{sum(sum(part['lost'].values()) for part in parts)} named as lost, "
        f"{sum(part['pending'] for part in parts)} pending; "
        f"longest stated tail {max((part['max_lost_tail_frames'] for part in parts), default=0)}"
    )
    yield f"sessions: {len(results) - lossy} complete, {lossy} lossy"
    yield "faults: " + ", ".join(f"{kind} {number}" for kind, number in sorted(kinds.items()))


def _report(results: list[Result], lines: list[str], options: argparse.Namespace) -> Iterator[str]:
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True
    ).stdout.strip()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    yield "# Rounds of faults\n"
    yield f"- date: {datetime.now(UTC):%Y-%m-%d}"
    yield f"- commit: {commit}"
    yield (
        f"- machine: {platform.machine()}, {os.cpu_count()} cores, {memory:.0f} GB, "
        f"Linux {platform.release()}, Python {platform.python_version()}"
    )
    arguments = ["--rounds", options.rounds, "--seed", options.seed, "--jobs", options.jobs]
    yield f"- command: `python tests/faults/rounds.py {shlex.join(map(str, arguments))}`\n"
    yield from (f"{line}\n" for line in lines)
    yield (
        "Each part is recorded / lost / pending / unsynced tail at most, in frames. What each "
        "fault does, and what the power cut models, is in `tests/faults/`.\n"
    )
    yield "| seed | faults | session | parts | time | verdict |"
    yield "|--:|---|---|---|--:|---|"
    for result in results:
        kind = "lossy" if result.ledger.get("lossy") else "complete"
        found = "; ".join(result.findings).replace("|", "/")[:300] or "good"
        yield (
            f"| {result.seed} | {result.faults} | {kind} | {summary_of(result.ledger)} | "
            f"{sum(result.times.values()):.1f} s | {found} |"
        )


if __name__ == "__main__":
    sys.exit(main())

"""An hour of four tiles in every format: seconds, CPU seconds, peak memory and bytes of the file.

    python benchmarks/formats.py [--minutes 60] [--tiles 4] [--only NAME ...]

Each is a `foottile export` in a process of its own, of a sealed session of noise, whose estimates
take about as many bytes as those that mean something. The file goes to the folder for temporary
files. Goals are of an hour of four tiles on an idle machine of two cores.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from side_by_side import table
from slices import write

from storage.formats.writers.registry import FORMATS

_RUN = """
import pathlib, sys
from service.cli.main import main
try:
    main()
finally:
    lines = pathlib.Path("/proc/self/status").read_text().splitlines()
    sys.stderr.write("\\n".join(line for line in lines if line.startswith("VmHWM")))
"""
"""The kernel's own count of the peak: what `wait4` says begins with that of the parent."""
_VARIANTS = {"mcap, ROS 2": ("mcap", "--messages", "ros2")}
_MB = 1_000_000
GOALS: dict[str, tuple[int, int | None]] = {
    **dict.fromkeys(("parquet", "arrow", "csv", "mat", "mcap"), (20, 300)),
    "mcap, ROS 2": (150, 300),
    **dict.fromkeys(("c3d", "opensim", "xdf"), (60, None)),
}
"""Seconds, and MB of memory."""


@dataclass(frozen=True)
class Cost:
    """What one export took."""

    wall_s: float
    cpu_s: float
    peak_bytes: int
    file_bytes: int
    code: int


def variants(only: list[str]) -> dict[str, tuple[str, ...]]:
    """Words for `foottile export` behind `--format`, by what they are called here."""
    all_ = {name: (name,) for name in FORMATS} | _VARIANTS
    return {name: words for name, words in all_.items() if not only or words[0] in only}


def cost(session: Path, words: tuple[str, ...], folder: Path) -> Cost:
    """Of one export."""
    out = folder / f"out{FORMATS[words[0]].ending}"
    command = [sys.executable, "-c", _RUN, "export", str(session), "--format", *words]
    begin_s, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command += ["--out", str(out)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    wall_s, after = time.perf_counter() - begin_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    size = out.stat().st_size if out.exists() else 0
    out.unlink(missing_ok=True)
    peak = re.search(r"VmHWM:\s+(\d+) kB", done.stderr)
    return Cost(wall_s, cpu_s, int(peak[1]) * 1024 if peak else 0, size, done.returncode)


def report(minutes: int, tiles: int, only: list[str]) -> list[str]:
    """A table with a row for each format."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        session = write(Path(folder), 1, minutes, tiles=tiles)
        rows.append(["sealed", "", "", "", f"{session.stat().st_size / _MB:.0f}", "", ""])
        for name, words in variants(only).items():
            found = cost(session, words, Path(folder))
            if found.code:
                rows.append([name, f"refused or failed, code {found.code}", *[""] * 5])
                continue
            seconds, megabytes = GOALS.get(name, (None, None))
            rows.append(
                [
                    name,
                    f"{found.wall_s:.1f}",
                    f"{found.cpu_s:.1f}",
                    f"{found.peak_bytes / _MB:.0f}",
                    f"{found.file_bytes / _MB:.0f}",
                    str(seconds or ""),
                    str(megabytes or ""),
                ]
            )
    head = ("format", "s", "CPU s", "peak MB", "file MB", "goal s", "goal MB")
    return table(head, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--tiles", type=int, default=4)
    parser.add_argument("--only", nargs="*", default=[], choices=list(FORMATS))
    asked = parser.parse_args()
    load = os.getloadavg()[0]
    print(*report(asked.minutes, asked.tiles, asked.only), sep="\n")
    print(f"\n{asked.minutes} min of {asked.tiles} tiles; load {load:.1f} at the start.")


if __name__ == "__main__":
    main()

"""What a recording takes: bytes a frame, and the work of keeping, sealing and reading it.

    python benchmarks/recording.py [--quick] [--only SECTION ...] [--out docs/results/recording.md]

Every figure stands beside the bare library, or another format, that does the same job in the same
run. CSV, HDF5 and Arrow files are written by their own libraries; h5py and hdf5plugin are the extra
`bench`. With `--out`, the sections that were run are replaced in that file, the others stay.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pyarrow as pa
from recording_costs import appending
from recording_data import QUICK, Extent
from recording_hours import hours
from recording_reading import read_back
from recording_sealing import sealed
from recording_sizes import sizes
from recording_turns import slices, writing

from studies.benchmark.run import describe_machine

Lines = list[str]


SECTIONS: dict[str, tuple[str, Callable[[Extent, Path], Lines]]] = {
    "sizes": ("Bytes a frame", sizes),
    "writing": ("Writing a whole recording", writing),
    "appending": ("Keeping frames while they are taken", appending),
    "sealing": ("Sealing an hour", sealed),
    "reading": ("Reading an hour back", read_back),
    "slices": ("Two seconds of one tile from the middle", slices),
    "hours": ("A journal of many hours", hours),
}


def _made_by(load_before: float) -> str:
    root = Path(__file__).resolve().parents[1]
    asked = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    answer = subprocess.run(asked, capture_output=True, text=True, check=False)
    commit = answer.stdout.strip() or "unknown"
    command = shlex.join(["python", "benchmarks/recording.py", *sys.argv[1:]])
    return (
        f"`{command}` at commit {commit}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC; load of the "
        f"machine {load_before:.1f} before and {os.getloadavg()[0]:.1f} after."
    )


def _replaced(page: str, name: str, body: Lines) -> str:
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    section = "\n".join([begin, *body, end])
    if begin not in page:
        return f"{page.rstrip()}\n\n{section}\n"
    head, _, rest = page.partition(begin)
    return head + section + rest.partition(end)[2]


def run(names: list[str], extent: Extent) -> dict[str, Lines]:
    """The sections, each in a temporary folder of its own; TMPDIR says on which disk."""
    done = {}
    for name in names:
        title, measure = SECTIONS[name]
        load = os.getloadavg()[0]
        with tempfile.TemporaryDirectory() as folder:
            lines = measure(extent, Path(folder))
        about = f"{describe_machine()}, pyarrow {pa.__version__}. {_made_by(load)}"
        done[name] = [f"## {title}", "", about, "", *lines]
        print("\n".join(done[name]) + "\n", flush=True)
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="little of everything, half a minute")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, help="sections; default: all")
    parser.add_argument("--hours", type=float, help="length of the long journal")
    parser.add_argument("--data", type=Path, help="folder of the measured walk")
    parser.add_argument("--out", type=Path, help="Markdown file whose sections are replaced")
    a = parser.parse_args()
    extent = QUICK if a.quick else Extent()
    given = {"hours": a.hours, "walk": a.data}
    extent = replace(extent, **{name: v for name, v in given.items() if v is not None})
    done = run(a.only or list(SECTIONS), extent)
    if a.out is not None:
        page = a.out.read_text("utf-8") if a.out.exists() else "# What a recording takes\n"
        for name, lines in done.items():
            page = _replaced(page, name, lines)
        a.out.write_text(page, "utf-8")


if __name__ == "__main__":
    main()

"""A flame graph of a process of ours as SVG: who called whom, and for how much of its CPU time.

    py-spy record --gil --format raw --function --rate 250 --duration 25 --pid PID --output s.txt
    python benchmarks/flame.py s.txt --title "Server, ..." --out docs/results/flame-server.svg

py-spy (its own project, not installed with ours) takes samples of what holds Python's lock: what
waits is not in it, nor what computes without the lock, as a compiled step and a hash do. A box is a
function, as wide as the time in it and in what it calls, which stands on it. Wrappers that do
nothing but call one other are left out.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from matplotlib import rc_context
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

OURS = ("service", "devices", "storage")
COLOURS = {"FootTile": "#e8833a", "libraries": "#7ea6c9", "Python itself": "#c9c9c9"}
LEAST = 0.004
"""Of the whole: narrower boxes are not drawn."""
WRAPPER = 0.97
"""What spends so much of its time in one function that it calls is left out, not that function."""
_WIDTH_IN, _ROW_IN, _POINTS = 13.0, 0.21, 7.5
_CHARACTER = 0.0051
"""Of the width, at that size."""
_FRAME = re.compile(r"(?P<name>.+) \((?P<path>[^()]+?)(:\d+)?\)")


@dataclass
class Box:
    """A function at one place of the stack.

    Attributes:
        name: with the file that it is in.
        kind: one of `COLOURS`.
        samples: in it and in what it calls.
        calls: what it calls, by name.
    """

    name: str
    kind: str
    samples: int = 0
    calls: dict[str, Box] = field(default_factory=dict)

    @property
    def depth(self) -> int:
        """Of the stack that begins with it."""
        return 1 + max((each.depth for each in self.calls.values()), default=0)


def named(frame: str) -> tuple[str, str]:
    """A frame's name for people, and its kind."""
    found = _FRAME.fullmatch(frame)
    if found is None:
        return frame, "Python itself"
    parts = Path(found["path"]).parts
    for top in OURS:
        if top in parts:
            where = "/".join(parts[parts.index(top) :])
            return f"{found['name']} ({where})", "FootTile"
    # Paths are relative to where modules are found: the first part is a module or a package.
    package = parts[0].removesuffix(".py")
    is_own = package in sys.stdlib_module_names or package.startswith("<")
    return f"{found['name']} ({package})", "Python itself" if is_own else "libraries"


def tree(folded: str) -> Box:
    """Samples, a stack and its count a line, as boxes that stand on one another."""
    stacks: Counter[tuple[str, ...]] = Counter()
    for line in folded.splitlines():
        frames, times = line.rsplit(" ", 1)
        stacks[tuple(frames.split(";"))] += int(times)
    whole = Box("all", "Python itself")
    for stack, count in stacks.items():
        whole.samples += count
        box = whole
        for frame in stack:
            name, kind = named(frame)
            box = box.calls.setdefault(name, Box(name, kind))
            box.samples += count
    whole.calls = {name: without_wrappers(box) for name, box in whole.calls.items()}
    return whole


def without_wrappers(box: Box) -> Box:
    """The same boxes without those that do nothing but call one other."""
    while len(box.calls) == 1:
        (only,) = box.calls.values()
        if only.samples < WRAPPER * box.samples:
            break
        box = only
    box.calls = {name: without_wrappers(each) for name, each in box.calls.items()}
    return box


def draw(whole: Box, title: str) -> Figure:
    """The figure."""
    rows = whole.depth
    figure = Figure(figsize=(_WIDTH_IN, 0.9 + _ROW_IN * rows), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, rows))
    axes.set_axis_off()
    axes.set_title(title, loc="left", fontsize=11)

    def put(box: Box, begin: float, row: int) -> None:
        width = box.samples / whole.samples
        if width < LEAST:
            return
        colour = COLOURS[box.kind]
        place = (begin, row)
        axes.add_patch(Rectangle(place, width, 0.94, facecolor=colour, edgecolor="white", lw=0.5))
        room = int(width / _CHARACTER) - 1
        share = f"{100.0 * width:.0f} % "
        text = share + box.name
        if len(text) > room:
            text = share + box.name.split(" (")[0]
        if room >= len(share):
            text = text if len(text) <= room else text[: room - 1] + "\u2026"
            axes.text(begin + 0.002, row + 0.47, text, va="center", fontsize=_POINTS)
        for each in sorted(box.calls.values(), key=lambda called: -called.samples):
            put(each, begin, row + 1)
            begin += each.samples / whole.samples

    put(whole, 0.0, 0)
    handles = [Patch(facecolor=colour, label=kind) for kind, colour in COLOURS.items()]
    figure.legend(handles=handles, loc="outside lower left", ncols=len(handles), fontsize=8)
    return figure


def main(words: list[str] | None = None) -> None:
    """Draw one; the command's words, or those that this was started with."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("samples", type=Path, help="what py-spy wrote")
    parser.add_argument("--title", required=True)
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args(words)
    whole = tree(asked.samples.read_text())
    title = f"{asked.title} \u2014 {whole.samples} samples"
    # No date and no random names: the same samples are the same file.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "flame"}):
        draw(whole, title).savefig(asked.out, metadata={"Date": None})


if __name__ == "__main__":
    main()

"""Jobs that take turns on a machine that others use too: CPU and wall time, medians and spread."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field


@dataclass
class Times:
    """What one job took in each of its turns, in seconds; CPU time is of all threads together."""

    cpu_s: list[float] = field(default_factory=list)
    wall_s: list[float] = field(default_factory=list)


def in_turns(jobs: Mapping[str, Callable[[], object]], turns: int) -> dict[str, Times]:
    """Every job once a turn, in an order that is reversed from turn to turn."""
    times = {name: Times() for name in jobs}
    for turn in range(turns):
        for name in list(jobs)[:: 1 if turn % 2 == 0 else -1]:
            wall_s, cpu_s = time.perf_counter(), time.process_time()
            jobs[name]()
            times[name].cpu_s.append(time.process_time() - cpu_s)
            times[name].wall_s.append(time.perf_counter() - wall_s)
    return times


def spread(values: Sequence[float], scale: float = 1.0, digits: int = 1) -> str:
    """Median, and in brackets the least and the greatest."""
    middle, low, high = (f(values) * scale for f in (statistics.median, min, max))
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> list[str]:
    """A Markdown table; the first `texts` columns are words, the others numbers."""
    rule = "|" + "|".join(["---"] * texts + ["--:"] * (len(head) - texts)) + "|"
    return [f"| {' | '.join(head)} |", rule, *(f"| {' | '.join(row)} |" for row in rows)]


def note(text: str) -> None:
    """Say what is measured now, to who waits."""
    print(f"  {text} ...", file=sys.stderr, flush=True)

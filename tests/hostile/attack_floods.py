"""Floods of small frames and of requests, by clients without a token that reconnect."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

from tests.hostile import flooder
from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.stage import Served, recording

_SECONDS = 4
_TIMES_MEDIAN, _LATER_P99_S = 2.0, 0.1
_LEAST_MEDIAN_S = 0.005
"""Less than this no person notices."""


@attack("floods of small frames, reconnecting", tries=_SECONDS, soak_tries=90)
def frames(play: Play) -> Outcome:
    """Eight flooders at 360 kB/s each, a third of the seconds with each kind; a try is a second.

    They send pings, empty fragments and messages, and connect again as soon as they are closed.
    Meanwhile a node records and a screen watches. It fails if a request takes more than twice as
    long as before (median; 99 of 100: 100 ms longer), if none of the flooders is closed, if the
    recording lacks a frame, or if node or screen are turned out.
    """
    outcome = Outcome()
    with Served(play.folder, outcome=outcome) as served, recording(served, outcome):
        quiet = _time_requests(served, max(3.0, play.tries / 3))
        for kind in flooder.KINDS:
            command = (sys.executable, flooder.__file__, str(served.port), kind)
            with subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            ) as flood:
                assert flood.stdout is not None
                flood.stdout.readline()
                time.sleep(0.2)
                times = _time_requests(served, play.tries / len(flooder.KINDS))
                said, _ = flood.communicate("", timeout=30.0)
            closed, refused = said.split()
            _judge(outcome, kind, quiet, times)
            outcome.figures[f"{kind}: connections closed, refused"] = f"{closed}, {refused}"
            if closed == "0":
                outcome.failures.append(f"{kind}: no flooder was closed")
        outcome.saw("a second of a flood", play.tries)
    return outcome


def _time_requests(served: Served, seconds: float) -> list[float]:
    times = []
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        began_s = time.monotonic()
        served.http.get("/health").raise_for_status()
        times.append(time.monotonic() - began_s)
        time.sleep(0.01)
    return sorted(times)


def _judge(outcome: Outcome, kind: str, quiet: list[float], times: list[float]) -> None:
    medians = [statistics.median(each) for each in (quiet, times)]
    slow = [each[int(0.99 * len(each))] for each in (quiet, times)]
    outcome.figures[f"{kind}: median, p99 of a GET"] = (
        f"{1e3 * medians[1]:.1f}, {1e3 * slow[1]:.0f} ms; "
        f"before {1e3 * medians[0]:.1f}, {1e3 * slow[0]:.0f} ms"
    )
    if medians[1] > max(_LEAST_MEDIAN_S, _TIMES_MEDIAN * medians[0]):
        outcome.failures.append(f"{kind}: a request takes {1e3 * medians[1]:.1f} ms")
    if slow[1] > slow[0] + _LATER_P99_S:
        outcome.failures.append(f"{kind}: one of a hundred takes {1e3 * slow[1]:.0f} ms")

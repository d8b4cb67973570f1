"""An emulated node whose acquisition is stopped and let go, beside a busy machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from typing import Any

from tests.builders.scenes import ONE_TILE_FILE
from tests.hostile.attack import Outcome, Play, attack
from tests.service.process import Process, acquisition_of
from tests.service.running import Running

_SOAK_TRIES = 12
_PATIENCE_S = 180.0
"""64 tiles are measured before the first frame, which takes its time on a busy machine."""
_SAID_S = 4.0
"""By then the node has said that acquisition is held up."""


@attack("acquisition stopped and let go beside a busy machine", tries=1, soak_tries=_SOAK_TRIES)
def held_up(play: Play) -> Outcome:
    """SIGSTOP and SIGCONT to the process that takes the frames of 64 tiles, for up to a minute.

    Small: one tile, for four seconds, on the machine as it is. It fails if the node ends, if frames
    do not go on in the same stream, if the node is not connected although it is heard of, if it
    does not say that acquisition is held up, or if a rate above the nominal one is shown.
    """
    outcome, is_soak = Outcome(), play.tries >= _SOAK_TRIES
    one_tile = play.folder / "one.toml"
    one_tile.write_text(ONE_TILE_FILE)
    running = Running(play.folder / "data")
    running.start()
    with ExitStack() as stack:
        stack.callback(running.stop)
        node = Process(
            *("node", "--scene", "grid" if is_soak else one_tile, "--server", running.url),
            *("--name", "leg"),
            folder=play.folder / "node",
        )
        stack.callback(node.close)
        if not _grows(running, 50):
            outcome.failed(f"never streamed: {node.err}")
            return outcome
        for _ in range(2 if is_soak else 0):
            busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(busy.wait)
            stack.callback(busy.kill)
        longest_s = 0.0
        for _ in range(play.tries):
            stopped_s = play.random.choice([0.3, 3.0, 12.0, 60.0]) if is_soak else _SAID_S
            before = running.node("leg")
            pid = acquisition_of(node)
            os.kill(pid, signal.SIGSTOP)
            time.sleep(stopped_s)
            during = running.node("leg")
            os.kill(pid, signal.SIGCONT)
            begun_s = time.monotonic()
            went_on = _grows(running, during["last_seq"] + 20)
            longest_s = max(longest_s, time.monotonic() - begun_s)
            after = running.node("leg")
            said = stopped_s < _SAID_S or any("held up" in text for text in during["warnings"])
            too_fast = (after["rate_hz"] or 0.0) > after["nominal_rate_hz"]
            if not went_on or node.process.poll() is not None:
                outcome.failed(f"after {stopped_s:g} s: no frames, {node.err[-3:]}")
                return outcome
            if after["stream_id"] != before["stream_id"] or not during["connected"]:
                outcome.failed(f"after {stopped_s:g} s: another stream, or away")
            elif not said or too_fast:
                outcome.failed(f"after {stopped_s:g} s: {during['warnings']}, {after['rate_hz']}")
            else:
                outcome.saw(f"stopped for {stopped_s:g} s: frames go on in the same stream")
        outcome.figures["longest until twenty frames"] = f"{longest_s:.1f} s"
    return outcome


def _grows(running: Running, beyond: int) -> bool:
    end_s = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end_s:
        nodes: list[dict[str, Any]] = running.http.get("/nodes").json()["items"]
        if nodes and (nodes[0]["last_seq"] or 0) > beyond:
            return True
        time.sleep(0.05)
    return False

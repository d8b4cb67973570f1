"""How long `foottile demo` takes to its first bar and force: `... first_bar.py [RUNS] [--empty]`.

Wall time from the start of the process, and CPU of all its processes until then. A bar is the first
message with a reading; the first force comes a second later, after the lead that is its tare. One
run before the others is not counted: parts are pressed on the bench and models compiled in it, once
for a machine. With `--empty` every run is that of a new machine: nothing is kept from before.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator

from served import COMMAND, children, cpu_s
from websockets.sync.client import connect

PATIENCE_S = 300.0


def family(pid: int) -> Iterator[int]:
    """A process and all that it has started."""
    yield pid
    for child in children(pid):
        yield from family(child)


def begun(*, is_new: bool = False) -> tuple[float, float, float]:
    """Seconds to the first bar and to the first force, and CPU seconds until that."""
    with tempfile.TemporaryDirectory() as folder:
        kept = dict.fromkeys(("XDG_CACHE_HOME", "NUMBA_CACHE_DIR"), f"{folder}/cache")
        environment = os.environ | (kept if is_new else {})
        began_s = time.monotonic()
        demo = subprocess.Popen(
            [*COMMAND, "demo", "--port=0", f"--data={folder}/data"],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert demo.stdout is not None
        try:
            url = demo.stdout.readline().split()[-1].partition("#")[0].rstrip("/")
            address = url.replace("http", "ws") + "/api/v1/live?rate_hz=60"
            bar_s = None
            with connect(address, compression=None, proxy=None) as socket:
                while time.monotonic() - began_s < PATIENCE_S:
                    message = json.loads(socket.recv(timeout=PATIENCE_S))
                    if message["type"] != "frame":
                        continue
                    bar_s = bar_s or time.monotonic() - began_s
                    if message["grf_n"] is not None:
                        force_s = time.monotonic() - began_s
                        return bar_s, force_s, sum(cpu_s(pid) for pid in family(demo.pid))
            raise TimeoutError("no force")
        finally:
            demo.terminate()
            demo.wait(60.0)
            demo.stdout.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=int, nargs="?", default=5)
    parser.add_argument("--empty", action="store_true")
    given = parser.parse_args()
    if not given.empty:
        begun()
    found = [begun(is_new=given.empty) for _ in range(given.runs)]
    print("| first bar s | first force s | CPU s until then |\n|--:|--:|--:|")
    cells = (
        f"{statistics.median(column):.2f} ({min(column):.2f} to {max(column):.2f})"
        for column in zip(*found, strict=True)
    )
    print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()

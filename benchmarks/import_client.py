"""How long `import foottile` takes: `python benchmarks/import_client.py [TURNS]`.

In processes of their own, in turn with one that imports nothing; the median of the difference, and
the same with `connect`, which brings httpx, and `live`, which brings Arrow and websockets.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time

CODES = {
    "nothing": "",
    "import": "import foottile",
    "connect": "import foottile; foottile.connect('http://127.0.0.1:1')",
}


def took_s(code: str) -> float:
    begin_s = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - begin_s


def main() -> None:
    turns = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    found: dict[str, list[float]] = {name: [] for name in CODES}
    for _ in range(turns):
        for name, code in CODES.items():
            found[name].append(took_s(code))
    medians = {name: statistics.median(each) for name, each in found.items()}
    nothing_s = medians.pop("nothing")
    print(json.dumps({f"{name}_s": round(s - nothing_s, 4) for name, s in medians.items()}))


if __name__ == "__main__":
    main()

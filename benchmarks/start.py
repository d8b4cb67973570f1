"""How long `foottile` takes to begin: `python benchmarks/start.py [RUNS]`.

CPU seconds of whole processes that take turns, medians and ranges: ours beside what cannot be done
without, which is Python itself and the libraries that the same job needs, imported and no more.
"""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys

LIBRARIES = "import fastapi, uvicorn, numpy, pyarrow, pyarrow.parquet, websockets, numba"
ROWS = {
    "`foottile --help`": ("import sys; sys.argv = ['foottile', '--help']; main()", "import typer"),
    "`foottile --version`": (
        "import sys; sys.argv = ['foottile', '--version']; main()",
        "import typer",
    ),
    "`foottile domes --help`": (
        "import sys; sys.argv = ['foottile', 'domes', '--help']; main()",
        "import typer, numpy, pydantic",
    ),
    "a server, imported": ("import service.cli.commands.serve, service.api.app", LIBRARIES),
}
"""What is begun: its code, and code that only imports the libraries it needs."""


def cpu_s(code: str) -> float:
    """CPU time of a Python process with this code."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def spread(times_s: list[float]) -> str:
    return f"{statistics.median(times_s):.3f} ({min(times_s):.3f} to {max(times_s):.3f})"


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 9
    bare = statistics.median(cpu_s("pass") for _ in range(runs))
    print(f"Python alone: {bare:.3f} s CPU\n")
    print("| what | ours s CPU | its libraries alone | ratio |")
    print("|---|--:|--:|--:|")
    for what, (ours, beside) in ROWS.items():
        code = ours if "main()" not in ours else f"from service.cli.main import main; {ours}"
        cpu_s(code)  # what is compiled once
        both: tuple[list[float], list[float]] = ([], [])
        for _ in range(runs):
            both[0].append(cpu_s(code))
            both[1].append(cpu_s(beside))
        ratio = statistics.median(both[0]) / statistics.median(both[1])
        print(f"| {what} | {spread(both[0])} | {spread(both[1])} | {ratio:.2f} |")


if __name__ == "__main__":
    main()

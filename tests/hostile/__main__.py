"""All attacks, and the table of what came of them.

    python -m tests.hostile --seed 1 [--soak] [--only WORD] [--out docs/results/hostile.md]

Exits with 1 if the product did what it must not do; each such try is said with its seed.
"""

# ruff: noqa: T201

from __future__ import annotations

import argparse
import importlib
import shlex
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

from tests.hostile.attack import ATTACKS, Outcome

_ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.hostile", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--soak", action="store_true", help="as many tries as --soak tests make")
    parser.add_argument("--only", default="", help="attacks with this word in their name")
    parser.add_argument("--out", type=Path, help="write the table here")
    options = parser.parse_args()
    for path in sorted(Path(__file__).parent.glob("attack_*.py")):
        importlib.import_module(f"tests.hostile.{path.stem}")
    rows: list[tuple[str, Outcome, float]] = []
    for attack in ATTACKS.values():
        if options.only not in attack.name:
            continue
        print(f"{attack.name} ...", flush=True)
        began = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="foottile-hostile-") as folder:
            outcome = attack.play(seed=options.seed, is_soak=options.soak, folder=Path(folder))
        rows.append((attack.name, outcome, time.monotonic() - began))
        print(f"  {_cells(outcome)}", flush=True)
        for failure in outcome.failures[:20]:
            print(f"  FAILED: {failure}", flush=True)
    text = _table(rows)
    print(text)
    if options.out is not None:
        options.out.write_text(text, "utf-8")
    return 1 if any(outcome.failures for _, outcome, _ in rows) else 0


def _table(rows: list[tuple[str, Outcome, float]]) -> str:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=_ROOT, capture_output=True, text=True
    ).stdout.strip()
    lines = [
        "# Attacks, and what came of them",
        "",
        f"{datetime.now(UTC):%Y-%m-%d}, commit {commit}, `{_command()}`. "
        "What each attack does, and what would count as a failure, is in the docstring of its "
        "function in `tests/hostile/`. What is defended and what is not: "
        "[security.md](../security.md).",
        "",
        "| attack | tries | what happened | measured beside it | failures | s |",
        "|---|--:|---|---|--:|--:|",
        *(
            f"| {name} | {outcome.tries} | {_cells(outcome)} | "
            f"{len(outcome.failures)} | {seconds:.0f} |"
            for name, outcome, seconds in rows
        ),
    ]
    return "\n".join(lines) + "\n"


def _cells(outcome: Outcome) -> str:
    happened = ", ".join(f"{what}: {times}" for what, times in outcome.outcomes.most_common())
    measured = ", ".join(f"{what}: {value}" for what, value in outcome.figures.items())
    return f"{happened} | {measured}"


def _command() -> str:
    return shlex.join(["python", "-m", "tests.hostile", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())

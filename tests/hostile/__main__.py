"""All attacks, and the table of what came of them.

    python -m tests.hostile --seed 1 [--soak | --tries N] [--only WORD] [--out FILE]

With `--out` a row is written as soon as its attack has ended, and takes the place of the row of an
earlier run of it: all of them take more than an hour, so they may be played one by one. A row says
at which commit it was played.

Exits with 1 if the product did what it must not do, each such try is said with its seed, or if an
attack could not be played.
"""

# ruff: noqa: T201  # a command prints

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from tests.hostile.attack import ATTACKS, Attack, Outcome

_ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.hostile", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--soak", action="store_true", help="as many tries as --soak tests make")
    parser.add_argument("--tries", type=int, help="of each attack, instead of its own number")
    parser.add_argument("--only", default="", help="attacks with this word in their name")
    parser.add_argument("--out", type=Path, help="write the table here")
    options = parser.parse_args()
    for path in sorted(Path(__file__).parent.glob("attack_*.py")):
        importlib.import_module(f"tests.hostile.{path.stem}")
    failed = 0
    for listed in ATTACKS.values():
        attack = listed
        if options.only not in attack.name:
            continue
        print(f"{attack.name} ...", flush=True)
        began = time.monotonic()
        if options.tries is not None:
            attack = replace(attack, tries=options.tries, soak_tries=options.tries)
        outcome = played(attack, seed=options.seed, is_soak=options.soak)
        row = _row(attack.name, outcome, time.monotonic() - began, options.seed)
        print(row, flush=True)
        for failure in outcome.failures[:20]:
            print(f"  FAILED: {failure}", flush=True)
        failed += len(outcome.failures)
        if options.out is not None:
            _write(options.out, attack.name, row)
    return 1 if failed else 0


def played(attack: Attack, *, seed: int, is_soak: bool) -> Outcome:
    """What came of an attack; one that could not be played has failed, and others follow it."""
    try:
        with tempfile.TemporaryDirectory(prefix="foottile-hostile-") as folder:
            return attack.play(seed=seed, is_soak=is_soak, folder=Path(folder))
    # What pytest raises where a test fails or is skipped is no Exception.
    except (Exception, pytest.fail.Exception, pytest.skip.Exception) as error:
        said = " ".join(str(error).split()).replace("|", "/")
        why = f"not played: {said[:200] or type(error).__name__}"
        return Outcome(outcomes=Counter({why: 1}), failures=[why])


def _write(path: Path, name: str, row: str) -> None:
    """The table with this row, others as they were; in the order of the list."""
    rows = {name: row}
    if path.exists():
        lines = path.read_text("utf-8").splitlines()
        rows = {line.split(" | ")[0].removeprefix("| "): line for line in lines} | rows
    path.write_text(_HEAD + "".join(f"{rows[each]}\n" for each in ATTACKS if each in rows), "utf-8")


_HEAD = """# Attacks, and what came of them

Made by `python -m tests.hostile --soak --seed SEED --out docs/results/hostile.md`, some rows with
`--tries N` in place of `--soak`. What each attack does, and what would count as a failure, is in
the docstring of its function in `tests/hostile/`. What is defended and what is not:
[security.md](../security.md).

| attack | tries | what happened | measured beside it | failures | s | seed | day, commit |
|---|--:|---|---|--:|--:|--:|---|
"""


def _row(name: str, outcome: Outcome, seconds: float, seed: int) -> str:
    return (
        f"| {name} | {outcome.tries} | {_cells(outcome)} | {len(outcome.failures)} | "
        f"{seconds:.0f} | {seed} | {datetime.now(UTC):%Y-%m-%d}, {_commit()} |"
    )


def _commit() -> str:
    """The one that is checked out; with a + if code was changed since."""
    code = ("devices", "storage", "service", "studies", "web", "tests")
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=_ROOT, capture_output=True, text=True
    )
    changed = subprocess.run(["git", "diff", "--quiet", "HEAD", "--", *code], cwd=_ROOT)
    return commit.stdout.strip() + "+" * (changed.returncode != 0)


def _cells(outcome: Outcome) -> str:
    happened = ", ".join(f"{what}: {times}" for what, times in outcome.outcomes.most_common())
    measured = ", ".join(f"{what}: {value}" for what, value in outcome.figures.items())
    return f"{happened} | {measured}"


if __name__ == "__main__":
    sys.exit(main())

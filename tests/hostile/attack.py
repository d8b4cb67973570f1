"""What an attack is, and the list of all: small in every test run, large with `--soak`.

An attack is a function that tries something hostile a number of times against real code, real
processes and real files, drawn from a seed, and says what came of it. It raises nothing for what
the product does wrong: it counts it, so that a table can show it. A test asserts that nothing was.

    @attack("flip in every file of a data folder", tries=300, soak_tries=20_000)
    def flips(play: Play) -> Outcome: ...
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random


@dataclass(frozen=True)
class Play:
    """What an attack is given."""

    tries: int
    random: Random
    folder: Path
    """Empty; for its files."""
    turn: int = 0
    """Which run it is: few tries may be other ones in each, so that in time all are made."""


@dataclass
class Outcome:
    """What came of an attack."""

    tries: int = 0
    """How often it was really tried."""
    outcomes: Counter[str] = field(default_factory=Counter)
    """How often what happened, in words: "refused with 4001", "noticed", "without effect"."""
    figures: dict[str, str] = field(default_factory=dict)
    """What was measured beside it, with units: "RSS of the server": "+3.1 MB"."""
    failures: list[str] = field(default_factory=list)
    """What must not happen and did: each with what is needed to play it again."""

    def saw(self, what: str, times: int = 1) -> None:
        """Count what happened in a try."""
        self.tries += times
        self.outcomes[what] += times

    def failed(self, what: str) -> None:
        """A try that did what none may do."""
        self.saw("failed")
        self.failures.append(what)


@dataclass(frozen=True)
class Attack:
    """One of the list."""

    name: str
    tries: int
    soak_tries: int
    run: Callable[[Play], Outcome]
    is_alone: bool = True
    """Does it measure time or memory, so that nothing else may run beside it?"""

    def play(self, *, seed: int, is_soak: bool, folder: Path, turn: int = 0) -> Outcome:
        """Run it; the same seed and turn draw the same."""
        tries = self.soak_tries if is_soak else self.tries
        random = Random(f"{self.name}/{seed}")  # noqa: S311  # drawn again from the seed, no secret
        return self.run(Play(tries, random, folder, turn))


ATTACKS: dict[str, Attack] = {}


def attack(
    name: str, *, tries: int, soak_tries: int, is_alone: bool = True
) -> Callable[[Callable[[Play], Outcome]], Attack]:
    """Put a function on the list.

    Args:
        name: in words; the row of the table.
        tries: how many in every test run; it should take seconds.
        soak_tries: how many with `--soak`; it may take minutes.
        is_alone: does it measure time or memory, so that nothing else may run beside it?
    """

    def listed(run: Callable[[Play], Outcome]) -> Attack:
        if name in ATTACKS:
            raise ValueError(f"two attacks are called {name!r}")
        ATTACKS[name] = Attack(name, tries, soak_tries, run, is_alone)
        return ATTACKS[name]

    return listed

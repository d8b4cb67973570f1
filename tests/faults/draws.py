"""Chance, or every chance: what decides which of the things a disk may have done it did."""

# ruff: noqa: S311  # seeded on purpose: a round can be run again

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol


class Remains(NamedTuple):
    """A file as it is after the cut."""

    content: bytes
    mode: int


Tree = dict[str, "Tree | Remains"]
"""What is in a folder after the cut."""


class Draws(Protocol):
    """Decides what the disk did; the first option is always that nothing more was kept."""

    def steps(self, count: int) -> int:
        """How many of `count` changes of names were kept, from 0 to all."""

    def choose(self, options: int) -> int:
        """What became of a file's bytes: one of `options`, from 0."""

    def between(self, low: int, high: int) -> int:
        """A length from `low` to `high`."""

    def noise(self, length: int) -> bytes:
        """Other people's bytes."""


_MOODS = ("strict", "names", "kind", "mixed")


class RandomDraws:
    """Draws of a seeded generator, which is in one of four moods for a whole cut.

    strict: everything that was not synced is gone. names: all names are there, and nothing in them
    but what was synced. kind: it is all there, as after a SIGKILL. mixed: any mixture.
    """

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self.mood = rng.choices(_MOODS, (0.3, 0.15, 0.1, 0.45))[0]

    def steps(self, count: int) -> int:
        if self.mood == "mixed":
            return self._rng.randint(0, count)
        return 0 if self.mood == "strict" else count

    def choose(self, options: int) -> int:
        if self.mood == "mixed":
            return self._rng.randrange(options)
        return options - 1 if self.mood == "kind" else 0

    def between(self, low: int, high: int) -> int:
        return self._rng.randint(low, high)

    def noise(self, length: int) -> bytes:
        return self._rng.randbytes(length)


class _Script:
    """One way through all choices: the given ones, then the first of each that follows."""

    def __init__(self, begin: list[int]) -> None:
        self.made: list[tuple[int, int]] = []
        self._begin = begin

    def steps(self, count: int) -> int:
        return self.choose(count + 1)

    def choose(self, options: int) -> int:
        at = len(self.made)
        choice = self._begin[at] if at < len(self._begin) else 0
        self.made.append((choice, options))
        return choice

    def between(self, low: int, high: int) -> int:
        return (low + high) // 2

    def noise(self, length: int) -> bytes:
        return random.Random(length).randbytes(length)


def every_outcome(tree: Callable[[Draws], Tree]) -> Iterator[Tree]:
    """All that a disk may hold (lengths between two bounds: only the middle)."""
    begin: list[int] = []
    while True:
        script = _Script(begin)
        yield tree(script)
        made = script.made
        while made and made[-1][0] == made[-1][1] - 1:
            made.pop()
        if not made:
            return
        begin = [choice for choice, _ in made[:-1]] + [made[-1][0] + 1]

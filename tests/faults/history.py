"""From a log of calls, and what is there now, to what a disk may hold.

The rules are in `power.py`.
"""

# ruff: noqa: S311  # seeded on purpose: a round can be run again

from __future__ import annotations

import json
import os
import random
from collections import defaultdict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.faults.draws import Draws, Remains, Tree

MAPPED = "in_flight"
_PAGE = 4096
_SECTOR = 512

Inode = tuple[int, str]
"""Number, and `d` for a folder or `f` for a file."""


class HarnessError(Exception):
    """The harness itself cannot go on; says nothing of the product."""


def scan(folder: str) -> dict[str, Inode]:
    """What is in a folder."""
    with os.scandir(folder) as entries:
        return {
            entry.name: (entry.inode(), "d" if entry.is_dir(follow_symlinks=False) else "f")
            for entry in entries
        }


def read_log(path: Path) -> list[dict[str, Any]]:
    """All whole lines of a log."""
    events = []
    for line in path.read_bytes().splitlines(keepends=True):
        if line.endswith(b"\n"):
            with suppress(ValueError):
                events.append(json.loads(line))
    return events


_Name = tuple[int, str]
"""A folder's inode number and a name in it."""


@dataclass
class _Step:
    """Names that change together."""

    changes: dict[_Name, tuple[Inode | None, Inode | None]]


@dataclass
class _Durable:
    """What has surely reached the disk, and what has not, in order."""

    names: dict[_Name, Inode | None] = field(default_factory=dict)
    lengths: dict[int, int] = field(default_factory=dict)
    copies: dict[int, str] = field(default_factory=dict)
    """What each file held when it was synced."""
    cuts: dict[int, list[tuple[int, str]]] = field(default_factory=lambda: defaultdict(list))
    steps: list[_Step] = field(default_factory=list)

    def take(self, event: Mapping[str, Any]) -> None:
        kind = event["e"]
        if kind == "base":
            self.__init__()  # type: ignore[misc]  # all begins anew
            for folder, names in event["folders"].items():
                for name, inode in names.items():
                    self.names[int(folder), name] = _inode(inode)
            for number, (length, copy) in event["files"].items():
                self.lengths[int(number)], self.copies[int(number)] = length, copy
        elif kind == "names":
            changes = {(f, n): (_inode(b), _inode(a)) for f, n, b, a in event["set"]}
            self.steps.append(_Step(changes))
        elif kind == "new_folder":
            self._forget_folder(event["ino"])
        elif kind == "folder":
            self._folder_synced(event["ino"], event["names"])
        elif kind == "file":
            self.lengths[event["ino"]], self.copies[event["ino"]] = event["len"], event["copy"]
            self.cuts.pop(event["ino"], None)
        elif kind == "cut":
            number = event["ino"]
            synced = self.lengths.get(number, 0)
            self.lengths[number] = min(synced, event["len"])
            if synced > event["len"]:
                self.cuts[number].append((event["len"], event["tail"]))
        elif kind == "let_go":
            self.lengths.pop(event["ino"], None)
            self.copies.pop(event["ino"], None)
            self.cuts.pop(event["ino"], None)

    def _forget_folder(self, number: int) -> None:
        for name in [name for name in self.names if name[0] == number]:
            del self.names[name]

    def _folder_synced(self, number: int, names: Mapping[str, Any]) -> None:
        left = []
        for step in self.steps:
            if not any(folder == number for folder, _ in step.changes):
                left.append(step)
                continue
            # A rename is one step: with it the name in the other folder is durable, too.
            for name, (_, after) in step.changes.items():
                self.names[name] = after
                for earlier in left:
                    earlier.changes.pop(name, None)
        self.steps = left
        self._forget_folder(number)
        for text, inode in names.items():
            self.names[number, text] = _inode(inode)


class History:
    """From a log and what is there now to what a disk may hold."""

    def __init__(self, root: Path, graveyard: Path, events: list[dict[str, Any]]) -> None:
        self._durable = _Durable()
        for event in sorted(events, key=lambda event: event.get("t", 0)):
            self._durable.take(event)
        self._root = root.stat().st_ino
        self._where: dict[int, str] = {}
        self._now: dict[_Name, Inode] = {}
        for top in (graveyard, root):
            for path, _, _ in os.walk(top):
                number = os.stat(path).st_ino
                for name, inode in scan(path).items():
                    self._where[inode[0]] = os.path.join(path, name)
                    if path != str(graveyard):
                        self._now[number, name] = inode
        self._steps = self._all_steps()

    def _all_steps(self) -> list[_Step]:
        """Everything since the last syncs, with what was done unseen (files that were created)."""
        steps: list[_Step] = []
        names: dict[_Name, Inode | None] = dict(self._durable.names)
        for step in self._durable.steps:
            for name, (before, _) in step.changes.items():
                if names.get(name) != before:
                    steps.append(_Step({name: (names.get(name), before)}))
            steps.append(step)
            names |= {name: after for name, (_, after) in step.changes.items()}
        for name in names.keys() | self._now.keys():
            if names.get(name) != self._now.get(name):
                steps.append(_Step({name: (names.get(name), self._now.get(name))}))
        return [step for step in steps if step.changes]

    def outcome(self, draws: Draws) -> Tree:
        names = dict(self._durable.names)
        for group in self._groups():
            kept = draws.steps(len(group))
            for step in group[:kept]:
                names |= {name: after for name, (_, after) in step.changes.items()}
        folders: dict[int, dict[str, Inode]] = defaultdict(dict)
        for (folder, name), inode in names.items():
            if inode is not None:
                folders[folder][name] = inode
        contents: dict[int, Remains] = {}

        def tree(number: int, depth: int) -> Tree:
            found: Tree = {}
            for name, inode in sorted(folders[number].items()):
                if inode[1] == "d":
                    if depth:  # a folder that was moved may be in itself, if only half of it is
                        found[name] = tree(inode[0], depth - 1)
                    continue
                if inode[0] not in contents:
                    contents[inode[0]] = self._content(inode[0], name, draws)
                found[name] = contents[inode[0]]
            return found

        return tree(self._root, 32)

    def _groups(self) -> list[list[_Step]]:
        """Steps that have names in common, directly or by others, each group in order."""
        leader: dict[_Name, _Name] = {}

        def find(name: _Name) -> _Name:
            while leader.setdefault(name, name) != name:
                name = leader[name]
            return name

        for step in self._steps:
            first, *others = step.changes
            for other in others:
                leader[find(other)] = find(first)
        groups: dict[_Name, list[_Step]] = defaultdict(list)
        for step in self._steps:
            groups[find(next(iter(step.changes)))].append(step)
        return [groups[name] for name in sorted(groups)]

    def _content(self, number: int, name: str, draws: Draws) -> Remains:
        path = self._where.get(number)
        if path is None:
            raise HarnessError(f"inode {number}, called {name}, cannot be brought back")
        now = Path(path).read_bytes()
        mode = os.stat(path).st_mode & 0o777
        if name.startswith(MAPPED):
            return Remains(_mapped(now, draws), mode)
        for length, tail in self._durable.cuts.get(number, []):
            if not draws.choose(2):  # the cut has not reached the disk, nor has what came after it
                return Remains(now[:length] + Path(tail).read_bytes(), mode)
        synced = min(self._durable.lengths.get(number, 0), len(now))
        old = Path(self._durable.copies[number]).read_bytes()[:synced] if synced else b""
        return Remains(_overwritten(old, now[:synced], draws) + _behind(now, synced, draws), mode)


def _overwritten(old: bytes, new: bytes, draws: Draws) -> bytes:
    """What is there of bytes that were written over synced ones, if any were."""
    if old == new:
        return new
    match draws.choose(3):
        case 0:
            return old
        case 1:
            rng = random.Random(draws.between(0, 1 << 30))
            sectors = [slice(at, at + _SECTOR) for at in range(0, len(new), _SECTOR)]
            return b"".join(rng.choice((old, new))[sector] for sector in sectors)
        case _:
            return new


def _behind(now: bytes, synced: int, draws: Draws) -> bytes:
    """What is behind the synced length."""
    tail = now[synced:]
    if not tail:
        return b""
    match draws.choose(6):
        case 0:
            return b""
        case 1:
            return tail[: draws.between(0, len(tail))]
        case 2:
            return bytes(len(tail))
        case 3:
            return draws.noise(draws.between(1, len(tail)))
        case 4:
            return _torn(now, _PAGE, draws)[synced:]
        case _:
            return tail


def _mapped(now: bytes, draws: Draws) -> bytes:
    match draws.choose(4):
        case 0:
            return bytes(len(now))
        case 1:
            return draws.noise(len(now))
        case 2:
            return _torn(now, _SECTOR, draws)
        case _:
            return now


def _torn(now: bytes, size: int, draws: Draws) -> bytes:
    """Pages or sectors were written in any order, and some were not."""
    seed = draws.between(0, 1 << 30)
    rng = random.Random(seed)
    pieces = []
    for begin in range(0, len(now), size):
        piece = now[begin : begin + size]
        pieces.append(rng.choice((piece, piece, bytes(len(piece)), rng.randbytes(len(piece)))))
    return b"".join(pieces)


def _inode(value: Any) -> Inode | None:
    return None if value is None else (int(value[0]), str(value[1]))

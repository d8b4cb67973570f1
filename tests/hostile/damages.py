"""What can happen to a file: of a folder, every one that a walk finds, in every way there is."""

from __future__ import annotations

import filecmp
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

from tests.hostile.attack import Play

FOREIGN = {
    "an empty list": b"[]",
    "null": b"null",
    "a number beyond all": b"1e999",
    "an empty object": b"{}",
    "100000 brackets": b"[" * 100_000,
    "100000 objects": b'{"a":' * 100_000,
    "no UTF-8": b"\xff\xfe\x00{}",
}


def files_of(folder: Path) -> list[Path]:
    """Every file below a folder, as paths relative to it."""
    return sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())


Damage = Callable[[Path, Random], None]


def _flipped(path: Path, random: Random) -> None:
    content = bytearray(path.read_bytes())
    if content:
        content[random.randrange(len(content))] ^= 1 << random.randrange(8)
    path.write_bytes(content)


def _cut(path: Path, random: Random) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: random.randrange(len(content) or 1)])


def _folder(path: Path, _: Random) -> None:
    path.unlink()
    path.mkdir()
    (path / "inside").write_bytes(b"x")


def _linked(target: str) -> Damage:
    def linked(path: Path, _: Random) -> None:
        path.unlink()
        path.symlink_to(target)

    return linked


def _moved(path: Path, _: Random) -> None:
    aside = path.with_name(f"moved-{path.name}")
    path.rename(aside)
    path.symlink_to(aside.name)


def _pipe(path: Path, _: Random) -> None:
    path.unlink()
    os.mkfifo(path)


def _forbidden(path: Path, _: Random) -> None:
    path.chmod(0)


def _replaced(content: bytes) -> Damage:
    def replaced(path: Path, _: Random) -> None:
        path.write_bytes(content)

    return replaced


NO_FILE: dict[str, Damage] = {
    "replaced by a folder": _folder,
    "replaced by a link to nowhere": _linked("nowhere"),
    "replaced by a link to /dev/zero": _linked("/dev/zero"),
    "replaced by a link to itself elsewhere": _moved,
    "replaced by a pipe": _pipe,
}
"""Damages after which there is no file any more."""
DAMAGES: dict[str, Damage] = {
    "a bit flipped": _flipped,
    "cut off": _cut,
    "emptied": _replaced(b""),
    **NO_FILE,
    **{f"replaced by {name}": _replaced(content) for name, content in FOREIGN.items()},
    # Root may read everything.
    **({} if os.geteuid() == 0 else {"forbidden": _forbidden}),
}


def damaged_copies(folder: Path, play: Play) -> Iterator[tuple[Path, Path, str, bool]]:
    """Copies with each damage of each file once in random order, then again from the start.

    Of each: the copy, the damaged file in it, file and damage in words, and whether the file has
    its content all the same. There are as many flips as all other damages together.
    """
    files, copy = files_of(folder), play.folder / "copy"
    others = [name for name in DAMAGES if name != "a bit flipped"]
    pairs = [(path, name) for path in files for name in others]
    done = 0
    while done < play.tries:
        play.random.shuffle(pairs)
        for pair in pairs:
            for path, name in (pair, (play.random.choice(files), "a bit flipped")):
                shutil.rmtree(copy, ignore_errors=True)
                shutil.copytree(folder, copy)
                DAMAGES[name](copy / path, play.random)
                is_file = (copy / path).is_file() and not (copy / path).is_symlink()
                is_same = is_file and filecmp.cmp(copy / path, folder / path, shallow=False)
                yield copy, path, f"{path} {name}", is_same
            done += 2
            if done >= play.tries:
                return

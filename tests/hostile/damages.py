"""What can happen to a file: of a folder, every one that a walk finds, in every way there is."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

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


def _flipped(path: Path, random: Random) -> None:
    content = bytearray(path.read_bytes())
    if content:
        content[random.randrange(len(content))] ^= 1 << random.randrange(8)
    path.write_bytes(content)


def _cut(path: Path, random: Random) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: random.randrange(len(content) or 1)])


def _empty(path: Path, _: Random) -> None:
    path.write_bytes(b"")


def _folder(path: Path, _: Random) -> None:
    path.unlink()
    path.mkdir()
    (path / "inside").write_bytes(b"x")


def _nowhere(path: Path, _: Random) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def _endless(path: Path, _: Random) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def _moved(path: Path, _: Random) -> None:
    aside = path.with_name(f"moved-{path.name}")
    path.rename(aside)
    path.symlink_to(aside.name)


def _pipe(path: Path, _: Random) -> None:
    path.unlink()
    os.mkfifo(path)


def _forbidden(path: Path, _: Random) -> None:
    path.chmod(0)


def _foreign(content: bytes) -> Callable[[Path, Random], None]:
    def replaced(path: Path, _: Random) -> None:
        path.write_bytes(content)

    return replaced


DAMAGES: dict[str, Callable[[Path, Random], None]] = {
    "a bit flipped": _flipped,
    "cut off": _cut,
    "emptied": _empty,
    "replaced by a folder": _folder,
    "replaced by a link to nowhere": _nowhere,
    "replaced by a link to /dev/zero": _endless,
    "replaced by a link to itself elsewhere": _moved,
    "replaced by a pipe": _pipe,
    **{f"replaced by {name}": _foreign(content) for name, content in FOREIGN.items()},
    # Root may read everything.
    **({} if os.geteuid() == 0 else {"forbidden": _forbidden}),
}


def plays(folder: Path, tries: int, random: Random) -> Iterator[tuple[Path, str]]:
    """Files and what happens to them: every pair once in random order, then again from the start.

    Of the flips there are as many as of all other damages together.
    """
    files = files_of(folder)
    others = [name for name in DAMAGES if name != "a bit flipped"]
    pairs = [(path, name) for path in files for name in others]
    done = 0
    while done < tries:
        random.shuffle(pairs)
        for path, name in pairs:
            yield path, name
            yield random.choice(files), "a bit flipped"
            done += 2
            if done >= tries:
                return

"""A power cut: what a disk could hold of a folder whose processes have been killed.

SIGKILL takes a process and leaves its page cache, so it proves nothing of fsync. Here a recorder
inside the processes (`bootstrap/fault_recorder.py`) notes what was synced, and afterwards the
folder is made what a disk may hold that was cut off at that instant:

- A file keeps what it had when its last fsync began. Of what was written behind that, nothing,
  some, or all is there, or zeros or other people's bytes stand in its place.
- Bytes that were written over synced ones since are there or not, sector by sector.
- A name that was given or taken since its folder was last synced is there or not. Changes of one
  name, or of names tied by renames, come undone from the newest back; a rename is one step, as it
  is on every journalling file system. Changes that have nothing to do with one another come in
  any order, and fsync of a file says nothing of its name.
- What was cut off a file (truncate, or opening it anew) may be back, unless it was synced since.
- Of files that are written through a mapping (`in_flight*`) every sector is any bytes at all.

That is what POSIX lets a disk do. ext4, XFS and btrfs are kinder: they keep the order of names, and
an fsync there makes more durable than it has to. A disk that lies about its cache is worse, and so
is one that damages its neighbours' sectors. Not modelled: O_SYNC, msync, sync(2).
"""

from __future__ import annotations

import json
import os
import random
import shutil
import stat
import uuid
from pathlib import Path
from typing import Any

from tests.faults.draws import Draws, RandomDraws, Remains, Tree
from tests.faults.history import History, Inode, read_log, scan

BOOTSTRAP = Path(__file__).parent / "bootstrap"
"""On PYTHONPATH of the processes under test."""


class Disk:
    """A watched folder, and what is known of its durability. One for each machine.

    Args:
        root: the folder; made, and taken to be durable as it is now.
        beside: a folder on the same file system, outside of `root`, for the harness's own files.
        synced: for copies of what was synced, where there is room for them; made.
    """

    def __init__(self, root: Path, beside: Path, synced: Path) -> None:
        self.root = root
        self.synced = synced
        self.log = beside / "calls.jsonl"
        self.graveyard = beside / "graveyard"
        self._stream_id = beside / "stream_id"
        root.mkdir(parents=True, exist_ok=True)
        self.begin()

    def environment(self) -> dict[str, str]:
        """What a process needs in its environment to be watched, and so do its children."""
        return {
            "PYTHONPATH": os.pathsep.join(
                filter(None, (str(BOOTSTRAP), os.environ.get("PYTHONPATH")))
            ),
            "FAULTS_ROOT": str(self.root),
            "FAULTS_LOG": str(self.log),
            "FAULTS_GRAVEYARD": str(self.graveyard),
            "FAULTS_SYNCED": str(self.synced),
            "FAULTS_BOOT_ID": str(self._stream_id),
        }

    def calls(self) -> list[dict[str, Any]]:
        """The recorded calls, oldest first: `kind` and `path` of each."""
        return [event for event in read_log(self.log) if event["e"] == "call"]

    def possible(self, draws: Draws) -> Tree:
        """One thing that the disk may hold if the power is cut now. Nothing is changed.

        Raises:
            HarnessError: something lost its name in a way that the recorder does not see.
        """
        return History(self.root, self.graveyard, read_log(self.log)).outcome(draws)

    def cut_power(self, rng: random.Random) -> str:
        """Make the folder what the disk holds; all its processes must have been killed before.

        Returns:
            What became of names and lengths, in a line.

        Raises:
            HarnessError: see `possible`.
        """
        before = _sizes(self.root)
        draws = RandomDraws(rng)
        tree = self.possible(draws)
        for child in self.root.iterdir():
            shutil.rmtree(child) if child.is_dir() else child.unlink()
        write_tree(tree, self.root)
        after = _sizes(self.root)
        self.begin()
        gone = [f"-{name}" for name in sorted(before.keys() - after.keys())]
        back = [f"+{name}" for name in sorted(after.keys() - before.keys())]
        common = sorted(before.keys() & after.keys())
        cut = [f"{n} {after[n] - before[n]:+d} bytes" for n in common if after[n] != before[n]]
        return f"{draws.mood}: " + (", ".join(gone + back + cut) or "nothing was gone")

    def begin(self) -> None:
        """All that is there is durable, and another boot of the kernel begins."""
        for folder in (self.graveyard, self.synced):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        folders: dict[int, dict[str, Inode]] = {}
        files: dict[int, tuple[int, str]] = {}
        for path, _, names in os.walk(self.root):
            folders[os.stat(path).st_ino] = scan(path)
            for name in names:
                found = os.stat(os.path.join(path, name), follow_symlinks=False)
                copy = str(self.synced / f"base-{found.st_ino}")
                if stat.S_ISREG(found.st_mode):
                    shutil.copyfile(os.path.join(path, name), copy)
                files[found.st_ino] = (found.st_size, copy)
        self.log.write_text(json.dumps({"e": "base", "folders": folders, "files": files}) + "\n")
        self._stream_id.write_text(f"{uuid.uuid4()}\n")


def read_tree(folder: Path) -> Tree:
    """What is in a folder."""
    tree: Tree = {}
    for path in folder.iterdir():
        mode = path.stat().st_mode & 0o777
        tree[path.name] = read_tree(path) if path.is_dir() else Remains(path.read_bytes(), mode)
    return tree


def write_tree(tree: Tree, folder: Path) -> None:
    """Write what is left into a folder."""
    for name, node in tree.items():
        path = folder / name
        if isinstance(node, Remains):
            path.write_bytes(node.content)
            path.chmod(node.mode)
        else:
            path.mkdir()
            write_tree(node, path)


def _sizes(root: Path) -> dict[str, int]:
    return {str(p.relative_to(root)): p.stat().st_size for p in root.rglob("*") if p.is_file()}

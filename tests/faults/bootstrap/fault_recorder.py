"""Inside the processes under test: notes what they have synced, slows it down, kills at points.

Standard library only, and nothing of the product. Everything is off unless the environment says so:

    FAULTS_ROOT       the folder that is watched
    FAULTS_LOG        where calls are noted, a line of JSON each, outside of that folder
    FAULTS_GRAVEYARD  what loses its name is kept here until that is durable; same file system
    FAULTS_SYNCED     what each file held at its last fsync
    FAULTS_KILL       KIND[+KIND...][@PART_OF_PATH]:N[:before|after]: SIGKILL at the Nth such call
    FAULTS_KILL_FILE  a file that may appear later, with the same in it; counting begins then
    FAULTS_SLOW       a file with the seconds that every fsync takes longer

KIND is fsync (of a file or folder), replace, rename, unlink, mkdir, rmdir, link, or any.
"""

from __future__ import annotations

import json
import os
import stat
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from fault_kill import KillPoint

_NAMES = (
    *("fsync", "fdatasync", "rename", "replace", "unlink", "remove", "mkdir", "rmdir", "link"),
    *("open", "close", "write", "read", "stat", "fstat", "scandir", "readlink"),
)
_real = {name: getattr(os, name) for name in _NAMES}


def install_from_environment() -> None:
    """Watch this process if the environment says so."""
    if root := os.environ.get("FAULTS_ROOT"):
        _Recorder(os.path.realpath(root)).install()


def scan(folder: str | int) -> dict[str, tuple[int, str]]:
    """Names in a folder: inode, and `d` for a folder or `f` for what is none."""
    with _real["scandir"](folder) as entries:
        return {
            entry.name: (entry.inode(), "d" if entry.is_dir(follow_symlinks=False) else "f")
            for entry in entries
        }


class _Recorder:
    def __init__(self, root: str) -> None:
        self._root = root
        self._graveyard = os.environ.get("FAULTS_GRAVEYARD")
        self._synced_copies = os.environ.get("FAULTS_SYNCED")
        self._log = -1
        if log := os.environ.get("FAULTS_LOG"):
            self._log = _real["open"](log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        kill = os.environ.get("FAULTS_KILL")
        self._kill = KillPoint(kill) if kill else None
        self._kill_file = os.environ.get("FAULTS_KILL_FILE")
        self._slow_file = os.environ.get("FAULTS_SLOW")
        # A listing taken while names change would be neither the old nor the new one.
        self._lock = threading.RLock()
        self._graves: dict[int, list[tuple[str, int]]] = {}
        self._copies: dict[int, tuple[int, str]] = {}
        self._count = 0

    def install(self) -> None:
        """Take the place of the functions of `os` that make things durable or move names."""
        for name in ("fsync", "fdatasync"):
            self._wrap(name, self._synced(name))
        for name in ("rename", "replace"):
            self._wrap(name, self._moved(name))
        for name in ("unlink", "remove"):
            self._wrap(name, self._unlinked(name))
        self._wrap("rmdir", self._rmdir)
        self._wrap("mkdir", self._mkdir)
        self._wrap("link", self._link)
        if self._graveyard is not None:
            sys.addaudithook(self._audit)

    def _wrap(self, name: str, function: Callable[..., None]) -> None:
        real = _real[name]
        # shutil looks here for what can be done safely.
        for supported in (os.supports_dir_fd, os.supports_follow_symlinks):
            if real in supported:
                supported.add(function)
        setattr(os, name, function)

    # --- what is durable --------------------------------------------------------------------------

    def _synced(self, name: str) -> Callable[[Any], None]:
        real = _real[name]

        def sync(descriptor: Any) -> None:
            number = descriptor if isinstance(descriptor, int) else descriptor.fileno()
            path = _path_of(number)
            if not self._inside(path):
                real(descriptor)
                return
            before = _real["fstat"](number)
            is_folder = stat.S_ISDIR(before.st_mode)
            names: dict[str, tuple[int, str]] = {}
            copy = None
            with self._lock:
                t_ns = time.monotonic_ns()
                if is_folder:
                    names = scan(number)
                elif self._synced_copies is not None:
                    self._count += 1
                    copy = os.path.join(self._synced_copies, f"{os.getpid()}-{self._count}")
                    _copy(f"/proc/self/fd/{number}", copy)
                graves = self._graves.pop(before.st_ino, []) if is_folder else []
            self._point("fsync", path, "before")
            self._dawdle()
            real(descriptor)
            # Noted when it has returned, with what was there when it began: whatever happened in
            # between may or may not be on the disk.
            if is_folder:
                self._note(e="folder", t=t_ns, ino=before.st_ino, names=names, path=path)
            else:
                facts = {"ino": before.st_ino, "len": before.st_size, "copy": copy}
                self._note(e="file", t=t_ns, **facts, path=path)
                if copy is not None:
                    self._keep_newest(before.st_ino, t_ns, copy)
            self._bury(graves)
            self._point("fsync", path, "after")

        return sync

    # --- what changes names -----------------------------------------------------------------------

    def _moved(self, name: str) -> Callable[..., None]:
        def move(src: Any, dst: Any, **of: Any) -> None:
            old, new = _place(src, of.get("src_dir_fd")), _place(dst, of.get("dst_dir_fd"))

            def changes() -> tuple[_Change, ...]:
                inode = _inode(old)
                return (old, inode, None), (new, _inode(new), inode)

            is_inside = self._inside(old) or self._inside(new)
            self._act(name, new, lambda: _real[name](src, dst, **of), changes, is_inside)

        return move

    def _unlinked(self, name: str) -> Callable[..., None]:
        def unlink(path: Any, *, dir_fd: int | None = None) -> None:
            place = _place(path, dir_fd)
            act = partial(_real[name], path, dir_fd=dir_fd)
            self._act("unlink", place, act, lambda: ((place, _inode(place), None),))

        return unlink

    def _rmdir(self, path: Any, *, dir_fd: int | None = None) -> None:
        place = _place(path, dir_fd)

        def act() -> None:
            grave = self._grave() if self._inside(place) else None
            if grave is None or _inode(place) is None or scan(place):
                _real["rmdir"](path, dir_fd=dir_fd)  # complains as it should
            else:
                _real["rename"](place, grave)  # a folder can have no second name

        self._act("rmdir", place, act, lambda: ((place, _inode(place), None),))

    def _mkdir(self, path: Any, mode: int = 0o777, *, dir_fd: int | None = None) -> None:
        place = _place(path, dir_fd)
        inside = self._inside(place)
        if inside:
            self._point("mkdir", place, "before")
        with self._lock:
            _real["mkdir"](path, mode, dir_fd=dir_fd)
            if inside:
                inode = _inode(place)
                self._note(e="new_folder", t=time.monotonic_ns(), ino=inode and inode[0])
                self._note_names((place, None, inode))
        if inside:
            self._point("mkdir", place, "after")

    def _link(self, src: Any, dst: Any, **of: Any) -> None:
        old, new = _place(src, of.get("src_dir_fd")), _place(dst, of.get("dst_dir_fd"))
        act = partial(_real["link"], src, dst, **of)
        self._act("link", new, act, lambda: ((new, None, _inode(old)),))

    def _act(
        self,
        kind: str,
        place: str,
        act: Callable[[], None],
        changes: Callable[[], tuple[_Change, ...]],
        is_inside: bool | None = None,
    ) -> None:
        """Do what gives and takes names; in the watched folder it is noted, and can be undone."""
        if not (self._inside(place) if is_inside is None else is_inside):
            act()
            return
        self._point(kind, place, "before")
        with self._lock:
            self._changing(act, *changes())
        self._point(kind, place, "after")

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Before a file is cut: keep what is cut off, which may be on the disk again later."""
        if event == "open":
            path, _, flags = arguments
            if flags & os.O_TRUNC and isinstance(path, str | bytes | os.PathLike):
                self._cutting(_place(path, None), 0)
        elif event == "os.truncate":
            path, length = arguments
            self._cutting(_path_of(path) if isinstance(path, int) else _place(path, None), length)

    def _cutting(self, path: str, length: int) -> None:
        if not self._inside(path):
            return
        try:
            before = _real["stat"](path)
        except OSError:
            return
        if not stat.S_ISREG(before.st_mode) or before.st_size <= length:
            return
        grave = self._grave()
        assert grave is not None
        _copy(path, grave, length)
        self._note(e="cut", t=time.monotonic_ns(), ino=before.st_ino, len=length, tail=grave)

    def _keep_newest(self, inode: int, t_ns: int, copy: str) -> None:
        with self._lock:
            older, newest = sorted([self._copies.get(inode, (0, "")), (t_ns, copy)])
            self._copies[inode] = newest
        if older[1]:
            _real["unlink"](older[1])

    def _changing(self, act: Callable[[], None], *changes: _Change) -> None:
        """Do `act`, which gives and takes names, so that it can be undone."""
        graves = []
        still_named = [after for _, _, after in changes]
        for path, before, _ in changes:
            if before is None or before in still_named or not self._inside(path):
                continue
            grave = self._grave()
            if grave is not None and before[1] == "f":
                with suppress(OSError):
                    _real["link"](path, grave, follow_symlinks=False)
                    graves.append((path, grave, before[0]))
        try:
            act()
        except BaseException:
            for _, grave, _ in graves:
                _real["unlink"](grave)
            raise
        for path, grave, inode in graves:
            folder = _real["stat"](os.path.dirname(path)).st_ino
            self._graves.setdefault(folder, []).append((grave, inode))
        self._note_names(*changes)

    def _note_names(self, *changes: _Change) -> None:
        t_ns = time.monotonic_ns()
        folders = {}
        for path, _, _ in changes:
            if self._inside(path):
                folders[path] = _real["stat"](os.path.dirname(path)).st_ino
        changed = [
            [folders[path], os.path.basename(path), before, after]
            for path, before, after in changes
            if path in folders
        ]
        self._note(e="names", t=t_ns, set=changed)

    def _bury(self, graves: list[tuple[str, int]]) -> None:
        """That they have lost their names is durable: let them go, or a full disk stays full."""
        for grave, inode in graves:
            with suppress(OSError):
                if _real["stat"](grave).st_nlink == 1:  # its number may be given to another file
                    self._note(e="let_go", t=time.monotonic_ns(), ino=inode)
                _real["unlink"](grave)

    def _grave(self) -> str | None:
        if self._graveyard is None:
            return None
        self._count += 1
        return os.path.join(self._graveyard, f"{os.getpid()}-{self._count}")

    # --- what else is done at such a call ---------------------------------------------------------

    def _point(self, kind: str, path: str, when: str) -> None:
        if self._kill is None and self._kill_file is not None:
            spec = _content(self._kill_file)
            if spec.endswith("\n"):
                with self._lock:
                    if self._kill is None:
                        self._kill = KillPoint(spec)
        if when == "before":
            self._note(e="call", t=time.monotonic_ns(), kind=kind, path=path)
        if self._kill is not None:
            self._kill.reached(kind, path, when)

    def _dawdle(self) -> None:
        if self._slow_file is not None and (seconds := _content(self._slow_file)):
            time.sleep(float(seconds))

    def _note(self, **event: object) -> None:
        if self._log >= 0:
            line = json.dumps({**event, "pid": os.getpid()}) + "\n"
            _real["write"](self._log, line.encode())

    def _inside(self, path: str) -> bool:
        return path.startswith(self._root + "/") or path == self._root


_Change = tuple[str, tuple[int, str] | None, tuple[int, str] | None]
"""A path, and its inode and type before and after."""


def _copy(path: str, to: str, offset: int = 0) -> None:
    """Copy a file from an offset on."""
    source = _real["open"](path, os.O_RDONLY)
    target = _real["open"](to, os.O_WRONLY | os.O_CREAT, 0o600)
    try:
        while piece := os.pread(source, 1 << 20, offset):
            _real["write"](target, piece)
            offset += len(piece)
    finally:
        _real["close"](source)
        _real["close"](target)


def _path_of(descriptor: int) -> str:
    return str(_real["readlink"](f"/proc/self/fd/{descriptor}"))


def _place(path: Any, dir_fd: int | None) -> str:
    """Where a name is: its folder with all links resolved, and the name as it is."""
    text = os.fsdecode(os.fspath(path))
    if dir_fd is not None and dir_fd >= 0:
        text = os.path.join(_path_of(dir_fd), text)
    head, tail = os.path.split(text.rstrip("/"))
    return os.path.join(os.path.realpath(head or "."), tail)


def _inode(path: str) -> tuple[int, str] | None:
    try:
        found = _real["stat"](path, follow_symlinks=False)
    except OSError:
        return None
    return found.st_ino, "d" if stat.S_ISDIR(found.st_mode) else "f"


def _content(path: str) -> str:
    try:
        descriptor = _real["open"](path, os.O_RDONLY)
    except OSError:
        return ""
    try:
        return str(_real["read"](descriptor, 256).decode())
    finally:
        _real["close"](descriptor)

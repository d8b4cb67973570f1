"""Single bits flipped, and ends cut off, in the files of data folders."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from storage.journal.segment import INDEX_SUFFIX, SUFFIX
from storage.verify.data_folder import DataFolderReport, Report, verify_path
from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.folders import (
    DELETED,
    REFUSED,
    SEALED,
    Readings,
    make_node,
    make_server,
    make_user,
    recovered_readings,
    session_readings,
    user_readings,
)

EVERY = 10

Change = Callable[[bytes, int], bytes]
"""A file's content with something done to it at this byte."""


@dataclass(frozen=True)
class Root:
    """One kind of folder, as it was before anything was flipped."""

    path: Path
    read: Callable[[Path, str], Readings]
    """Every number that may depend on the file of this name, from a folder that is a copy."""


@attack("a flip in every file of a data folder", tries=60, soak_tries=8500, is_alone=False)
def flips(play: Play) -> Outcome:
    """One bit at a tenth byte of one file of a server's, a node's or a user's folder, drawn anew.

    Then `foottile verify`, and every reader of what may depend on the file: columns of sealed
    frames, events, the server's time, calibrations, and a session that is sealed now from journal,
    tares and calibration. It fails if one of them crashes; if verify does not name the file, unless
    every number is the same to the bit; and, named or not, if a reader gives other numbers without
    refusing, counting a loss, or saying a problem. Rows of a clock log that
    are left out only widen the bounds, and count as no other number.
    """

    def flipped(content: bytes, at: int) -> bytes:
        flip = 1 << play.random.randrange(8)
        return content[:at] + bytes([content[at] ^ flip]) + content[at + 1 :]

    return _play(play, flipped)


@attack("a file of a data folder, cut anywhere", tries=30, soak_tries=2000, is_alone=False)
def cuts(play: Play) -> Outcome:
    """The same with all cut off from a tenth byte on, the first included.

    What a crash leaves is no damage: a segment without a batch, and lines or records at the end of
    a log or an index that was not closed. Verify need not name these; no number may change.
    """
    return _play(play, lambda content, at: content[:at])


def _play(play: Play, change: Change) -> Outcome:
    outcome = Outcome()
    roots = _roots(play.folder)
    before = {root.path: _all_readings(root, play.folder / "copy") for root in roots}
    places = [
        (root, path.relative_to(root.path), at)
        for root in roots
        for path in sorted(root.path.rglob("*"))
        if path.is_file()
        for at in range(0, path.stat().st_size, EVERY)
    ]
    # As many of a small file as of a large one, until all of it is done.
    play.random.shuffle(places)
    seen: Counter[tuple[Path, Path]] = Counter()
    order: list[tuple[int, int]] = []
    for number, (root, name, _) in enumerate(places):
        seen[root.path, name] += 1
        order.append((seen[root.path, name], number))
    for _, number in sorted(order)[: play.tries]:
        root, name, at = places[number]
        _try(outcome, root, name, at, change, before[root.path])
    outcome.figures["files"] = str(len(seen))
    outcome.figures["tenth bytes in all"] = str(len(places))
    return outcome


def _roots(folder: Path) -> list[Root]:
    server, node, user = folder / "server", folder / "node", folder / "calibrations"
    make_server(server)
    make_node(node)
    make_user(user)
    return [
        Root(server, _server_readings),
        Root(node, lambda copy, name: recovered_readings(copy)),
        Root(user, lambda copy, name: user_readings(copy)),
    ]


def _server_readings(copy: Path, name: str) -> Readings:
    found: Readings = {}
    for place, session_id in (("sessions", SEALED), ("trash", DELETED)):
        if not name or session_id in name:
            found |= session_readings(copy / place / session_id)
    if not name or not found:
        found |= recovered_readings(copy)
    return found


def _all_readings(root: Root, copy: Path) -> Readings:
    shutil.copytree(root.path, copy)
    try:
        problems = verify_path(copy).to_json_dict()["problems"]
        if problems:
            raise AssertionError(f"{root.path.name} is not whole: {problems}")
        found = root.read(copy, "")
        if refused := [text for text in found.values() if text.startswith(REFUSED)]:
            raise AssertionError(f"{root.path.name} is not readable: {refused}")
        return found
    finally:
        shutil.rmtree(copy)


def _try(
    outcome: Outcome, root: Root, name: Path, at: int, change: Change, before: Readings
) -> None:
    copy = root.path.with_name("copy")
    shutil.copytree(root.path, copy)
    changed_to = change((copy / name).read_bytes(), at)
    (copy / name).write_bytes(changed_to)
    where = f"{root.path.name}/{name}, byte {at}: {changed_to[at : at + 1]!r}"
    try:
        report = verify_path(copy)
        said = _said(report)
        # Of a segment and its index either may be named.
        named = name.stem if name.suffix in (SUFFIX, INDEX_SUFFIX) else name.name
        is_named = named in said
        after = root.read(copy, str(name))
    except Exception as error:  # whatever it is, it must not
        outcome.failed(f"{where}: {type(error).__name__}: {error}")
        return
    finally:
        shutil.rmtree(copy)
    changed = {reader: text for reader, text in after.items() if before[reader] != text}
    silent = [reader for reader, text in changed.items() if not text.startswith(REFUSED)]
    if silent:
        noticed = "named by verify" if is_named else "unnoticed"
        outcome.failed(f"{where}: {noticed}, and other numbers in {', '.join(silent)}")
    elif changed and not is_named:
        outcome.failed(f"{where}: verify does not name it, and refused are {changed}")
    elif changed:
        outcome.saw("named by verify, refused or counted by what reads it")
    elif is_named:
        outcome.saw("named by verify, no number changed")
    else:
        outcome.saw("not named, and without effect on any number")


def _said(report: Report) -> str:
    """All that verify says of what is not as it should be."""
    found = report.to_json_dict()
    remarks = [
        remark
        for stream in (report.streams if isinstance(report, DataFolderReport) else [])
        for remark in stream.remarks
    ]
    return "\n".join([*found["problems"], *found.get("unproven", ()), *remarks])

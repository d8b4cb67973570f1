"""A server on a data folder of which a file is not what was written."""

from __future__ import annotations

import asyncio
import threading
import time
from pathlib import Path
from typing import Any

from devices.errors import FootTileError
from service.server.broadcast.views import make_session_view
from service.server.data_folder import SERVER_NAME
from service.server.server import Server
from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.damages import DAMAGES, damaged_copies
from tests.hostile.data_folders import NODES, copied, data_folder, digest, sha

START_S = 5.0
"""A server on this little folder starts in a fraction of it."""


Served = dict[str, Any]


def served(server: Server) -> Served:
    """What a server gives away, by what it is of."""
    found: Served = {}
    for node in server.nodes:
        found[f"node {node.name}"] = server.make_node_view(node).model_dump_json()
        for stream_id, stream in node.streams.items():
            numbers = list(stream.stored)
            try:
                journal = stream.journal
                assert journal is not None
                frames = [digest(b) for n in numbers for b in journal.read_frames(*n)]
            except FootTileError as error:
                frames = [f"damaged: {error}"]
            found[f"stream {stream_id}"] = (node.name, numbers, frames)
    for session in server.sessions.iterate_newest_first():
        view = make_session_view(session, server.recorder).model_dump_json()
        folder = server.sessions.folder.get_path(session.id)
        files = {p.name: sha(p) for p in sorted(folder.iterdir()) if p.suffix == ".parquet"}
        found[f"session {session.id}"] = (view, files)
    return found


def _views(now: Served) -> str:
    """What sessions say of themselves: one that is made again says so there."""
    return str([value for key, value in now.items() if key.startswith("session")])


def _started(data: Path) -> tuple[Served, list[str], float]:
    async def start() -> tuple[Served, list[str], float]:
        began_s = time.monotonic()
        server = Server(data)
        took_s = time.monotonic() - began_s
        try:
            return served(server), server.file_problems, took_s
        finally:
            await server.close()

    return asyncio.run(start())


def _may_change(path: Path, whole: Served) -> set[str]:
    """What may be served otherwise if a file is damaged: what it is of."""
    name = path.parts[1] if len(path.parts) > 1 else ""
    streams = {key for key, value in whole.items() if key.startswith("stream") and name in value}
    pending = {k for k, v in whole.items() if '"pending"' in str(v) and name in str(v)}
    match path.parts:
        case ("nodes", _, "hello.json"):  # nothing is known of it, until it says hello again
            return {f"node {name}"} | streams | pending
        case ("nodes", _, _):
            return {f"node {name}"}
        case ("journal", _, stream_id, *_):
            return {f"node {name}", f"stream {stream_id}"} | pending
        case ("sessions", session_id, *_):
            return {f"session {session_id}", *(f"node {node}" for node in NODES)}
        case _:
            return set()


_SAID = ("hello.json", "tares.json", "stream.json", "session.json", SERVER_NAME)


@attack("every file of a server's data folder, damaged in every way", tries=40, soak_tries=4_000)
def folder_of_a_server(play: Play) -> Outcome:
    """One file of a data folder is damaged, then a server is started on it.

    Failures: it does not start within seconds; something else than what the file is of is served
    otherwise than before; what describes nodes, tares, streams or sessions is damaged, and no
    problem names it.
    """
    outcome = Outcome()
    data = data_folder(play.folder / "data")
    whole, problems, _ = _started(copied(data, play.folder / "whole"))
    if problems:
        outcome.failed(f"undamaged: {problems}")
    slowest_s = 0.0
    for copy, path, what, is_same in damaged_copies(data, play):
        found = _in_time(copy)
        if not isinstance(found, tuple):
            outcome.failed(f"{what}: {found}")
            continue
        now, said, took_s = found
        slowest_s = max(slowest_s, took_s)
        changed = {key for key in {*whole, *now} if whole.get(key) != now.get(key)}
        if wrong := changed - _may_change(path, whole):
            outcome.failed(f"{what}: {sorted(wrong)}")
        elif path.name in _SAID and not is_same and path.name not in f"{said} {_views(now)}":
            outcome.failed(f"{what}: nothing is said of it: {said}")
        elif said:
            outcome.saw("said by name, all else served as before")
        else:
            outcome.saw("served as before")
    outcome.figures["slowest start"] = f"{slowest_s:.2f} s"
    if "forbidden" not in DAMAGES:
        outcome.figures["no permission"] = "not tried: root may read everything"
    return outcome


def _in_time(copy: Path) -> tuple[Served, list[str], float] | str:
    """What is served, or why nothing is: in a thread, because it might wait for ever."""
    found: list[Any] = []

    def start() -> None:
        try:
            found.append(_started(copy))
        except BaseException as error:
            found.append(f"{type(error).__name__}: {error}")

    thread = threading.Thread(target=start, daemon=True)
    thread.start()
    thread.join(START_S * 4)
    return found[0] if found else "it does not start"

"""A server on a data folder, and a node on its own, of which a file is not what was written."""

from __future__ import annotations

import asyncio
import hashlib
import shutil
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from devices.acquisition import FrameRow
from devices.errors import FootTileError
from devices.frames import FrameBatch
from service.estimation.estimates import EstimateStatus
from service.link import Hello
from service.server.following import sources_now
from service.server.node import ServerNode
from service.server.nodes import ServerNodes
from service.server.screens.views import NodeView, SessionView
from service.server.server import Server
from service.sessions.frames import SessionFrames
from storage.intervals import Intervals, OpenPairs
from storage.journal.node.in_flight import InFlight
from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream
from storage.journal.node.wanted import ServerWants
from storage.server_id import SERVER_ID_NAME
from storage.sessions.folder import SessionFolder
from storage.wire import messages_of
from tests.builders.arrays import make_array
from tests.builders.frames import make_frames
from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.damages import DAMAGES, plays
from tests.service.fake_node import FakeNode
from tests.service.running import Running
from tests.waiting import until

START_S = 5.0
"""A server on this little folder starts in a fraction of it."""
NODES = ("left", "right")


def data_folder(folder: Path) -> Path:
    """A data folder of a server with all there is: two nodes, tares, marks, clocks, sessions.

    Of each node one session is sealed, and one of the left's is pending.
    """
    with (
        patch("service.server.server.TICK_S", 0.02),
        patch("service.server.recorder.BEHIND_S", 1e9),  # its frames are long ago
        patch("service.api.routes.sessions.SETTLE_S", 0.02),
    ):
        _record(folder)
    (folder / "token").write_text("a-token-of-an-earlier-start\n")
    return folder


def _record(folder: Path) -> None:
    running = Running(folder)
    running.start()
    nodes = [FakeNode(running, name) for name in NODES]
    try:
        for node in nodes:
            node.connect()
            node.tared()
            node.next_t_mono_ns += 11_000_000_000
            node.deliver(300, 2.0, alive=True)
            assert running.http.post(f"/nodes/{node.name}/tare", json={}).status_code == 201
            session = node.record(name="walk", tags=["a"])
            node.deliver(100, 5.0)
            event = {"label": "step"}
            assert running.http.post(f"{session.url}/events", json=event).status_code == 201
            node.finish(session)
            if node is nodes[0]:
                pending = node.record(name="pending")
                node.deliver(100, 7.0)
                node.leave()
                newest_ns = node.next_t_mono_ns
                until(lambda newest_ns=newest_ns: time.monotonic_ns() > newest_ns)  # type: ignore[misc]
                pending.stop()
                assert pending.now()["state"] == "pending"
    finally:
        for node in nodes:
            node.close()
        running.stop()


Served = dict[str, Any]


def served(server: Server) -> Served:
    """What a server gives away, by what it is of."""
    found: Served = {}
    for node in server.nodes:
        found[f"node {node.name}"] = NodeView.of(node, server.recorder).model_dump_json()
        for boot_id, stream in node.streams.items():
            numbers = list(stream.held)
            try:
                frames = [_digest(b) for n in numbers for b in stream.journal.read(*n)]  # type: ignore[union-attr]
            except FootTileError as error:
                frames = [f"damaged: {error}"]
            found[f"stream {boot_id}"] = (node.name, numbers, frames)
    for session in server.sessions:
        view = SessionView.of(session, server.recorder).model_dump_json()
        folder = server.sessions.folder.path(session.id)
        files = {p.name: _sha(p) for p in sorted(folder.iterdir()) if p.suffix == ".parquet"}
        found[f"session {session.id}"] = (view, files)
    return found


def _views(now: Served) -> str:
    """What sessions say of themselves: one that is made again says so there."""
    return str([value for key, value in now.items() if key.startswith("session")])


def _digest(batch: FrameBatch) -> str:
    columns = [getattr(batch, column.name) for column in fields(batch)]
    return hashlib.sha256(b"".join(column.tobytes() for column in columns)).hexdigest()


def _sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "no file"


def _started(data: Path) -> tuple[Served, list[str], float]:
    async def start() -> tuple[Served, list[str], float]:
        began_s = time.monotonic()
        server = Server(data)
        took_s = time.monotonic() - began_s
        try:
            return served(server), server.problems, took_s
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
        case ("journal", _, boot_id, *_):
            return {f"node {name}", f"stream {boot_id}"} | pending
        case ("sessions", session_id, *_):
            return {f"session {session_id}", *(f"node {node}" for node in NODES)}
        case _:
            return set()


_SAID = ("hello.json", "tares.json", "stream.json", "session.json", SERVER_ID_NAME)


@attack("every file of a server's data folder, damaged in every way", tries=40, soak_tries=4_000)
def folder_of_a_server(play: Play) -> Outcome:
    """One file of a data folder is damaged, then a server is started on it.

    Failures: it does not start within seconds; something else than what the file is of is served
    otherwise than before; what describes nodes, tares, streams or sessions is damaged, and no
    problem names it.
    """
    outcome = Outcome()
    data = data_folder(play.folder / "data")
    whole, problems, _ = _started(_copy(data, play.folder / "whole"))
    if problems:
        outcome.failed(f"undamaged: {problems}")
    slowest_s = 0.0
    for path, damage in plays(data, play.tries, play.random):
        what = f"{path} {damage}"
        copy = _copy(data, play.folder / "copy")
        DAMAGES[damage](copy / path, play.random)
        is_same = _says_the_same(copy / path, data / path)
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


def _says_the_same(now: Path, before: Path) -> bool:
    if now.is_symlink() or not now.is_file():
        return False
    if now.name == SERVER_ID_NAME:
        # With another space at its end it is the same; cut behind its 32 digits it is the same id,
        # as a version without a CRC-32 wrote it.
        whole = before.read_bytes().strip()
        return now.read_bytes().strip() in (whole, whole[:32])
    return _sha(now) == _sha(before)


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


def _copy(data: Path, to: Path) -> Path:
    shutil.rmtree(to, ignore_errors=True)
    return shutil.copytree(data, to)


# --- the law of tares -----------------------------------------------------------------------------

_NUMBERS = ("gauge_kpa", "force_n", "force_sigma_n", "grf_n", "grf_sigma_n", "cop_x_m", "cop_y_m")
Numbers = Mapping[str, np.ndarray]


@attack("a bit flipped in tares.json", tries=24, soak_tries=2_600, is_alone=False)
def flipped_tares(play: Play) -> Outcome:
    """A bit is flipped at every byte in turn; then forces are computed live, and a session sealed.

    Failures: a number that is neither bit for bit the one without the flip, nor NaN with bit 512 of
    `estimate_status`; a flip that is not said.
    """
    outcome = Outcome()
    data = data_folder(play.folder / "data")
    path = data / "nodes" / "left" / "tares.json"
    text = path.read_bytes()
    hello = ServerNodes(data).get("left").hello
    whole, _ = _estimated(data, hello)
    places = list(range(len(text)))
    play.random.shuffle(places)
    for number in range(play.tries):
        at, bit = places[number % len(places)], play.random.randrange(8)
        for aside in path.parent.glob("tares.json*"):
            aside.unlink()
        path.write_bytes(text[:at] + bytes([text[at] ^ 1 << bit]) + text[at + 1 :])
        now, said = _estimated(data, hello)
        wrong = [name for name in whole if not _is_right_or_lost(whole[name], now[name])]
        if wrong or not said:
            outcome.failed(f"byte {at} bit {bit}: {wrong or 'nothing is said'}")
        elif any(
            (columns["estimate_status"] & EstimateStatus.TARE_LOST).any()
            for columns in now.values()
        ):
            outcome.saw("said, and forces are NaN")
        else:
            outcome.saw("said, and the same numbers")
    outcome.figures["bytes of the file"] = str(len(text))
    return outcome


def _estimated(data: Path, hello: Hello) -> tuple[dict[str, Numbers], bool]:
    """Live forces of what a node sent last, and of all its sessions sealed anew."""
    node = ServerNode(data / "nodes" / "left", data / "journal" / "left", hello)
    found: dict[str, Numbers] = {"live": _live(node)}
    for path in sorted((data / "sessions").iterdir()):
        session = SessionFolder(data / "sessions").load(path.name)
        if session.node == "left":
            session = session.model_copy(update={"state": "pending"})
            pieces = [columns for _, columns in SessionFrames(sources_now(session, node))]
            found[path.name] = _joined(pieces)
    return found, bool(node.problems)


def _live(node: ServerNode) -> Numbers:
    journal = node.journal
    assert journal is not None
    due = [c for batch in journal.read(0, 2**61) for _, c in node.live.feed(batch)]
    return _joined(due)


def _joined(pieces: list[Any]) -> Numbers:
    names = (*_NUMBERS, "estimate_status")
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


def _is_right_or_lost(whole: Numbers, now: Numbers) -> bool:
    lost = (now["estimate_status"] & EstimateStatus.TARE_LOST) != 0
    for name in _NUMBERS:
        rows = whole[name].reshape(len(whole[name]), -1), now[name].reshape(len(now[name]), -1)
        if rows[0].shape != rows[1].shape or rows[0][~lost].tobytes() != rows[1][~lost].tobytes():
            return False
        if not np.isnan(rows[1][lost]).all():
            return False
    return True


# --- a node's own folder --------------------------------------------------------------------------

BOOTS = ("a" * 32, "b" * 32)
_NODE_SAYS = ("wanted.json", "stream.json")


def node_folder(folder: Path) -> Path:
    """The state of a node that was killed: a stream that ended, one in flight, what is wanted."""
    live = folder.with_name(f"{folder.name}-live")
    journal = NodeJournal(live, "leg")
    journal.start()
    wants: dict[str, OpenPairs] = {BOOTS[0]: ((0, 49),), BOOTS[1]: ((100, None),)}
    journal.want("laptop", ServerWants(streams=wants, recording=True, known=BOOTS))
    for boot_id in BOOTS:
        info = make_array(node="leg", boot_id=boot_id)
        stream = journal.begin(info)
        in_flight = InFlight(stream.folder, info)
        for first in range(0, 200, 10):
            frames = make_frames(np.arange(first, first + 10))
            for row in rows_of(frames):
                in_flight.put(row)
            for message in messages_of(frames, info):
                journal.put(stream, message)
        in_flight.close()
        until(partial(_is_stored, stream))
    until((live / "journal" / "leg" / "wanted.json").exists)
    until(lambda: not (live / "journal" / "leg" / BOOTS[0] / "in_flight").exists())
    shutil.copytree(live, folder)  # as SIGKILL leaves it
    journal.close()
    return folder


@attack(
    "every file of a node's folder, damaged in every way",
    tries=30,
    soak_tries=2_000,
    is_alone=False,
)
def folder_of_a_node(play: Play) -> Outcome:
    """One file of a node's state is damaged, then its journal is opened, goes on and is tidied.

    Failures: it does not open; a frame is other than it was; a frame of a stream that is not
    damaged is gone; what says what is wanted, or of a stream, is damaged and no problem names it; a
    new stream is not kept.
    """
    outcome = Outcome()
    data = node_folder(play.folder / "node")
    for path, damage in plays(data, play.tries, play.random):
        what = f"{path} {damage}"
        copy = _copy(data, play.folder / "copy")
        DAMAGES[damage](copy / path, play.random)
        is_same = (copy / path).is_file() and _sha(copy / path) == _sha(data / path)
        is_same = is_same and not (copy / path).is_symlink()
        try:
            wrong, said = _goes_on(copy, [boot for boot in BOOTS if boot not in path.parts])
        except FootTileError as error:
            outcome.failed(f"{what}: {error}")
            continue
        is_named = any(path.name in text for text in said)
        if wrong:
            outcome.failed(f"{what}: {wrong}")
        elif path.name in _NODE_SAYS and not is_same and not is_named:
            outcome.failed(f"{what}: nothing is said of it: {said}")
        else:
            outcome.saw("said by name, and it goes on" if is_named else "it goes on")
    return outcome


def _goes_on(root: Path, undamaged: Sequence[str]) -> tuple[str, list[str]]:
    """What is wrong with a node's journal that is opened now, and what it says."""
    journal = NodeJournal(root, "leg")
    journal.start()
    try:
        info = make_array(node="leg", boot_id="c" * 32)
        stream = journal.begin(info)
        for message in messages_of(make_frames(np.arange(10)), info):
            journal.put(stream, message)
        until(lambda: stream.stored.last == 9)
        known = {each.boot_id: each for each in journal.streams}
        for boot_id in undamaged:
            if boot_id not in known or known[boot_id].held != Intervals([(0, 199)]):
                return f"stream {boot_id} is not whole", journal.problems
        for each in known.values():
            read = 0
            try:
                for batch in each.journal.read(0, 199) if each.journal else ():
                    taken = make_frames(batch.seq.astype(np.int64))
                    if _digest(batch) != _digest(taken):
                        return "other frames", journal.problems
                    read += len(batch)
            except FootTileError as error:
                if each.boot_id in undamaged:
                    return f"stream {each.boot_id}: {error}", journal.problems
            if each.boot_id in undamaged and read != 200:
                return f"of stream {each.boot_id} only {read} are read", journal.problems
        return "", list(journal.problems)
    finally:
        journal.close()


def _is_stored(stream: NodeStream) -> bool:
    return stream.stored.last == 199 and stream.is_synced


def rows_of(frames: FrameBatch) -> list[FrameRow]:
    """Frames one by one, as acquisition has them."""
    return [
        FrameRow(*(getattr(frames, name)[i].tolist() for name in FrameRow._fields))
        for i in range(len(frames))
    ]

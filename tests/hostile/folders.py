"""Small data folders as a server, a node and a user leave them, and every number read from them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from devices.errors import FootTileError
from devices.frames import ArrayInfo
from service.offline.calibration_lookup import read_calibration
from service.protocol.link import PROTOCOL, Hello
from service.server.data_folder import SERVER_NAME, ServerIdentity
from service.sessions.calibration_file import write_calibration
from service.sessions.recovery import recover_locked_folder
from service.sessions.tares import TareHistory
from storage.clock.log import ClockLog, ClockOffset
from storage.documents import write_document
from storage.journal.node.retention import RetentionRequest, RetentionRequests
from storage.permissions import SECRETS_NAME, write_secrets
from storage.sessions.folder import FRAMES_NAME, Marker, Part, SessionsFolder
from storage.sessions.metadata import MARKERS_NAME, load_clock_table, read_existing_markers
from storage.sessions.reader import SealedFileReader
from tests.builders.arrays import make_array
from tests.builders.calibrations import make_calibration, make_tare
from tests.service.sessions.crashed import BOOT, session, stream, t_ns

SEALED = "20200101T000000Z-00000a"
DELETED = "20200101T000000Z-00000b"
PENDING = "20200101T000000Z-00000c"
FRAMES = 120
SERVER_ID = "5" * 32
SECRET = "5ec2e7" + "0" * 58
REFUSED = "refused: "

Readings = dict[str, str]
"""What each reader gives: a hash of its numbers, or `REFUSED` and the error."""


def make_server(data: Path) -> None:
    """A server's: a sealed session, one in the trash, one that waits, journal, clock, tares."""
    info, node = make_array(stream_id=BOOT), data / "nodes" / "bench"
    TareHistory(node / "tares.json").store_tare_in_force(make_tare(t_ns=t_ns(0)), info)
    hello = Hello(
        protocol=PROTOCOL,
        array_info=info,
        stored=((0, FRAMES - 1),),
        next_seq=FRAMES,
        t_mono_ns=0,
        scene={"name": "test"},
        emulated=True,
        calibration=make_calibration("T01", "T02"),
        calibration_problem=None,
    )
    write_document(node / "hello.json", hello)
    write_secrets(node / SECRETS_NAME, {"bench": SECRET})
    write_document(data / SERVER_NAME, ServerIdentity(server_id=SERVER_ID))
    (data / "token").write_text("a token that nobody has\n")
    folder = _journal(data, info)
    log = ClockLog(folder)
    for row in range(6):
        log.append(
            ClockOffset(
                stream_id=BOOT,
                t_mono_ns=row * 30_000_000,
                server_minus_node_ns=1_000_000 + row,
                uncertainty_ns=300_000 - row,
            )
        )
    _session(data, SEALED, 5, 60)
    recover_locked_folder(data, abandon_missing=True)
    _session(data, DELETED, 20, 40)
    sessions = SessionsFolder(data / "sessions")
    sessions.move_to(DELETED, SessionsFolder(data / "trash"))
    _session(data, PENDING, 50, FRAMES - 1)


def make_node(root: Path) -> None:
    """A node's that recorded by itself and was killed."""
    folder = _journal(root, make_array(stream_id=BOOT))
    wanted = RetentionRequests(folder.parent / "retention.json")
    write_secrets(folder.parent / SECRETS_NAME, {SERVER_ID: SECRET})
    wanted.update_request_in_memory(
        SERVER_ID, RetentionRequest(streams={BOOT: ((0, None),)}, known=(BOOT,))
    )
    wanted.save()
    _session(root, PENDING, 0, FRAMES - 1)


def make_user(folder: Path) -> None:
    """A user's calibrations."""
    folder.mkdir()
    write_calibration(folder / "toe.json", make_calibration("T01", "T02"))


def _journal(data: Path, info: ArrayInfo) -> Path:
    return stream(data, info, (0, FRAMES - 1), next_seq=FRAMES)


def _session(data: Path, session_id: str, first: int, last: int) -> None:
    session(
        data,
        session_id,
        state="pending",
        stopped_t_ns=t_ns(last),
        parts=(Part(stream_id=BOOT, seq_first=first, seq_last=last),),
        markers=(Marker(id="e1", label="slip", t_ns=t_ns(first + 3)),),
        calibration=make_calibration("T01", "T02").model_dump(mode="json"),
    )


def session_readings(folder: Path) -> Readings:
    """What a session's files give, each by itself; of one that is not sealed there is only one."""
    readers: Mapping[str, Callable[[], bytes]] = {
        "session": lambda: (
            SessionsFolder(folder.parent).load(folder.name).model_dump_json().encode()
        ),
        "frames": lambda: _frames(folder / FRAMES_NAME),
        "markers": lambda: repr(read_existing_markers(folder / MARKERS_NAME)).encode(),
        "clock": lambda: _clock(folder / FRAMES_NAME),
    }
    wanted = readers if folder.name == SEALED else {"session"}
    return {
        f"{folder.name} {name}": _read(reader) for name, reader in readers.items() if name in wanted
    }


def recovered_readings(data: Path) -> Readings:
    """What a session gives that is sealed now, from journal, tares, clock log and calibration.

    A loss that its ledger counts, or a problem that it says, is as good as a refusal.
    """

    def sealed() -> bytes:
        recover_locked_folder(data, abandon_missing=True)
        done = SessionsFolder(data / "sessions").load(PENDING)
        ledger = done.ledger
        if ledger is None or ledger.lossy or done.problem:
            raise FootTileError(done.problem or f"the ledger says {ledger}")
        return _frames(data / "sessions" / PENDING / FRAMES_NAME)

    return {"sealed now": _read(sealed)}


def user_readings(folder: Path) -> Readings:
    """What calibrations give."""
    return {path.name: _read(partial(_calibration, path)) for path in sorted(folder.glob("*.json"))}


def _calibration(path: Path) -> bytes:
    return read_calibration(path).model_dump_json().encode()


def _frames(path: Path) -> bytes:
    """Every column of every frame, whatever the file says beside them."""
    digest = hashlib.sha256()
    with SealedFileReader(path) as reader:
        digest.update(reader.info.model_dump_json(exclude={"software"}).encode())
        for table in reader.read_tables():
            for name in table.column_names:
                digest.update(name.encode())
                values = table.column(name).to_numpy()
                digest.update(np.ascontiguousarray(values).tobytes())
    return digest.digest()


def _clock(path: Path) -> bytes:
    with SealedFileReader(path) as reader:
        table = load_clock_table(reader)
        columns = [
            table.compute_server_time_columns_or_unknown(
                frames.t_mono_ns, frames.t_ns, extra["part"]
            )
            for frames, extra in reader.read_batches("part")
        ]
    values = [values.tobytes() for each in columns for values in each.values()]
    return b"".join([table.summarize_streams().model_dump_json().encode(), *values])


def _read(reader: Callable[[], bytes]) -> str:
    try:
        return hashlib.sha256(reader()).hexdigest()
    except FootTileError as error:
        return f"{REFUSED}{error}"

"""What cannot be read now, however whole it is, is neither set aside nor written over."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from devices.errors import StorageError
from service.api.address import load_or_create_token
from service.offline.calibration_lookup import read_calibration
from service.server import recorder
from service.server.data_folder import DataFolder
from service.server.nodes import NodeRegistry
from service.server.server import Server
from service.sessions.calibration_file import write_calibration
from service.sessions.tares import TareHistory
from storage import durable_files
from storage.documents import write_checksummed_json
from storage.journal import journal as journal_module
from storage.journal.node.in_flight import IN_FLIGHT_FILE, InFlightWriter
from storage.journal.node.journal import NodeJournal
from storage.journal.node.retention import RetentionRequest, RetentionRequests
from storage.journal.stream_notes import StreamNotes
from tests.builders.arrays import make_array
from tests.builders.calibrations import make_calibration, make_tare
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running
from tests.storage.faulty_disk import IO_ERROR, failing_if, refusing
from tests.waiting import until

INFO = make_array()
NEEDED = RetentionRequest(streams={"a": ((0, 9),)})


@contextmanager
def unreadable(monkeypatch: pytest.MonkeyPatch, number: int) -> Iterator[None]:
    """No file of ours can be opened to be read: descriptors or memory are used up, or another's."""

    with monkeypatch.context() as patched:
        refuse = refusing(OSError, number, os.strerror(number))
        patched.setattr(durable_files, "_without_following", refuse)
        yield


def refuse_opening(monkeypatch: pytest.MonkeyPatch, path: Path, number: int) -> None:
    """Let this one file not be opened."""
    facts = (OSError, number, os.strerror(number))
    opened = durable_files._without_following
    refuse = failing_if(lambda name, _: name == str(path), opened, *facts)
    monkeypatch.setattr(durable_files, "_without_following", refuse)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != ".lock"
    }


def _tares(folder: Path) -> None:
    TareHistory(folder / "tares.json").store_tare_in_force(make_tare(2), INFO)


def _wanted(folder: Path) -> None:
    wanted = RetentionRequests(folder / "retention.json")
    wanted.update_request_in_memory("other", NEEDED)
    wanted.save()


def _server_id(folder: Path) -> None:
    DataFolder(folder).release_lock()


def _token(folder: Path) -> None:
    load_or_create_token(None, folder)


def _calibration(folder: Path) -> None:
    path = folder / "mine.json"
    if not path.exists():
        write_calibration(path, make_calibration("T01"))
    read_calibration(path)


def _stream(folder: Path) -> None:
    stream = folder / "journal" / "bench" / INFO.stream_id
    if not stream.exists():
        stream.mkdir(parents=True)
        StreamNotes(array_info=INFO, number=1).save(stream)
        InFlightWriter(stream, INFO).close()
        assert (stream / IN_FLIGHT_FILE).exists()
    journal = NodeJournal(folder, "bench")
    try:
        assert journal.problems == [] or "The file is unchanged" in journal.problems[0]
        assert bool(journal.problems) is not bool(journal.streams)
    finally:
        journal.end_streams_and_close()


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENOMEM, errno.EACCES, errno.ESTALE])
@pytest.mark.parametrize("use", [_tares, _wanted, _server_id, _token, _calibration, _stream])
def test_a_file_that_cannot_be_read_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: Callable[[Path], None], number: int
) -> None:
    use(tmp_path)
    before = contents(tmp_path)
    with unreadable(monkeypatch, number):
        if use is _stream:
            use(tmp_path)
        else:
            with pytest.raises(StorageError, match="Let this user read it, or try again") as caught:
                use(tmp_path)
            assert caught.value.errno == number
    assert contents(tmp_path) == before


def test_a_node_goes_on_and_writes_what_servers_need_only_once_it_was_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _wanted(tmp_path)
    with unreadable(monkeypatch, errno.EACCES):
        wanted = RetentionRequests(tmp_path / "retention.json")
        assert wanted.is_unknown
        assert "frames are kept" in wanted.problems[0]
        assert wanted.update_request_in_memory("laptop", NEEDED)
        with pytest.raises(StorageError):
            wanted.save()
    wanted.save()
    again = RetentionRequests(tmp_path / "retention.json")
    assert not again.update_request_in_memory("other", NEEDED)
    assert not again.update_request_in_memory("laptop", NEEDED)


def test_tares_that_are_damaged_and_cannot_be_set_aside_are_not_written_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _tares(tmp_path)
    path = tmp_path / "tares.json"
    path.write_bytes(path.read_bytes()[:-1])
    before = contents(tmp_path)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", refusing(OSError, errno.EMFILE, "Too many open files"))
        with pytest.raises(StorageError, match="Move it away by hand"):
            TareHistory(path)
    assert contents(tmp_path) == before
    assert len(TareHistory(path).all_tares_with_undone) == 1


@pytest.mark.parametrize("name", ["hello.json", "tares.json"])
def test_a_node_whose_files_cannot_be_read_is_left_out_until_it_connects(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    running.stop()
    folder = running.data / "nodes" / "bench"
    before = contents(folder)
    with monkeypatch.context() as patched:
        refuse_opening(patched, folder / name, errno.EACCES)
        found = NodeRegistry(running.data)
    assert (list(found), contents(folder)) == ([], before)
    assert name in found.file_problems[0]
    running.start()
    tared.connect()
    assert running.node()["tare"] is not None


@contextmanager
def refused_journals(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The disk does not give what journals hold."""

    monkeypatch.setattr(recorder, "_RETRY_S", 0.1)
    with monkeypatch.context() as disk:
        disk.setattr(journal_module, "recover_or_delete_segment", refusing(*IO_ERROR))
        yield


def stopped_after_fifty(node: FakeNode, recording: Recording) -> None:
    """The session ends after fifty frames more, and is told to wait for what cannot be read."""
    node.send(50, 5.0)
    node.taken_in()
    recording.stop()
    node.send(10, now=True)
    node.taken_in()
    until(lambda: "cannot be read now" in (recording.now()["problem"] or ""))


@pytest.mark.parametrize("is_mentioned", [True, False])
def test_frames_in_a_journal_that_cannot_be_read_now_are_not_lost(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch, *, is_mentioned: bool
) -> None:
    recording = tared.record()
    tared.deliver(100, 5.0)  # acknowledged: the node has forgotten them
    running.stop()
    with refused_journals(monkeypatch):
        running.start()
        tared.reboot()
        mentioned = tuple(earlier.said(stored=()) for earlier in tared.before)
        tared.connect(earlier=mentioned if is_mentioned else ())
        stopped_after_fifty(tared, recording)
        assert recording.now()["state"] == "pending"
        said = " ".join(running.http.get("/health").json()["problems"])
        assert "left out until it can be read" in said
    sealed = recording.sealed()
    assert (sealed["frames"], sealed["lost"]) == (150, {})
    assert np.bincount(recording.column("part")).tolist() == [100, 50]


def test_who_gives_up_what_cannot_be_read_keeps_what_followed_it(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tared.record()
    tared.deliver(100, 5.0)
    running.stop()
    with refused_journals(monkeypatch):
        running.start()
        tared.reboot()
        tared.connect()
        stopped_after_fifty(tared, recording)
        assert running.http.post(f"{recording.url}/abandon-missing").status_code == 200
        sealed = recording.sealed()
    assert (sealed["complete"], sealed["frames"]) == ("lossy", 50)


def test_frames_of_a_stream_whose_notes_another_version_wrote_are_not_lost(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "_RETRY_S", 0.1)
    recording = tared.record()
    tared.deliver(100, 5.0)
    running.stop()
    notes = running.data / "journal" / "bench" / tared.stream_id / "stream.json"
    ours = notes.read_bytes()
    theirs = json.loads(ours) | {"of_later": 1}
    del theirs["check"]
    write_checksummed_json(notes, json.dumps(theirs).encode())
    running.start()
    tared.reboot()
    tared.connect()
    recording.stop()
    tared.send(10, now=True)
    until(lambda: "cannot be read now" in (recording.now()["problem"] or ""))
    notes.write_bytes(ours)
    assert recording.sealed()["frames"] == 100


def test_a_session_that_cannot_be_read_stays_as_it_is_and_is_named(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tared.record_sealed(100, 5.0)
    running.stop()
    before = contents(running.data / "sessions")
    with monkeypatch.context() as patched:
        refuse_opening(patched, recording.folder / "session.json", errno.ENFILE)
        server = Server(running.data)
        said = " ".join(server.sessions.problems)
        server.data_folder.release_lock()
    assert "Too many open files" in said
    assert contents(running.data / "sessions") == before
    running.start()
    assert len(running.http.get("/sessions").json()["items"]) == 1

"""Sessions that a node records for itself: which streams each of them takes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from devices.errors import FileFormatError
from devices.frames import ArrayInfo
from service.node.local_recording import LocalRecording
from storage.journal.node.journal import NodeJournal
from storage.sessions.folder import Session, SessionsFolder
from tests.builders.arrays import make_array

Recording = Callable[..., LocalRecording]


def stream(number: int, tiles: int = 2) -> ArrayInfo:
    return make_array(tiles, stream_id=f"{number:032x}")


def sessions(folder: Path) -> dict[str, Session]:
    found, unreadable = SessionsFolder(folder / "sessions").load_all()
    assert unreadable == {}
    return {session.name: session for session in found}


def streams_of(session: Session) -> list[int]:
    return [int(part.stream_id, 16) for part in session.parts]


@pytest.fixture
def journal(tmp_path: Path) -> NodeJournal:
    return NodeJournal(tmp_path, "bench", is_recovery=True)


@pytest.fixture
def recording(tmp_path: Path, journal: NodeJournal) -> Recording:
    def make(name: str | None = "mud") -> LocalRecording:
        return LocalRecording(
            tmp_path,
            "bench",
            journal,
            session_name=name,
            calibration=None,
            scene_content={},
            is_emulated=True,
            report=lambda _: None,
        )

    return make


def test_a_session_goes_on_in_every_stream_of_the_same_tiles(
    tmp_path: Path, journal: NodeJournal, recording: Recording
) -> None:
    first = recording()
    first.add_stream(journal.switch_to_new_stream(stream(1)))
    first.add_stream(journal.switch_to_new_stream(stream(2)))
    recording().add_stream(
        journal.switch_to_new_stream(stream(3))
    )  # the process was killed in between
    assert streams_of(sessions(tmp_path)["mud"]) == [1, 2, 3]


def test_other_tiles_begin_a_session_that_says_which_one_it_takes_up(
    tmp_path: Path, journal: NodeJournal, recording: Recording
) -> None:
    first = recording()
    first.add_stream(journal.switch_to_new_stream(stream(1)))
    first.add_stream(journal.switch_to_new_stream(stream(2, tiles=3)))
    ended, further = sessions(tmp_path)["mud"], sessions(tmp_path)["mud (2)"]
    assert (streams_of(ended), ended.state) == ([1], "pending")
    assert "other tiles" in (ended.problem or "")
    assert ended.stopped_t_ns == further.started_t_ns
    assert (streams_of(further), further.continues, further.state) == ([2], ended.id, "recording")
    # After a crash it is that one which goes on, and the first is sealed.
    second = recording()
    second.add_stream(journal.switch_to_new_stream(stream(3, tiles=3)))
    assert streams_of(sessions(tmp_path)["mud (2)"]) == [2, 3]
    second.seal_earlier_sessions()
    assert sessions(tmp_path)["mud"].state == "sealed"
    assert sessions(tmp_path)["mud (2)"].state == "recording"


def test_a_session_whose_sealing_was_interrupted_goes_on_without_its_earlier_stop(
    tmp_path: Path, journal: NodeJournal, recording: Recording
) -> None:
    recording().add_stream(journal.switch_to_new_stream(stream(1)))
    begun = sessions(tmp_path)["mud"]
    closed = begun.parts[0].model_copy(update={"seq_last": -1})
    stopped = {"state": "sealing", "stopped_t_ns": begun.started_t_ns, "parts": (closed,)}
    SessionsFolder(tmp_path / "sessions").save_session_json(begun.model_copy(update=stopped))
    recording().add_stream(journal.switch_to_new_stream(stream(2)))
    now = sessions(tmp_path)["mud"]
    # With that stop `foottile recover` would leave out all frames from here on.
    assert (now.state, now.stopped_t_ns, streams_of(now)) == ("recording", None, [1, 2])


def test_a_session_whose_calibration_cannot_be_read_is_sealed_and_says_so(
    tmp_path: Path, journal: NodeJournal, recording: Recording
) -> None:
    first = recording()
    first.add_stream(journal.switch_to_new_stream(stream(1)))
    (begun,) = sessions(tmp_path).values()
    spoilt = begun.model_copy(update={"calibration": {"this": "is none"}})
    SessionsFolder(tmp_path / "sessions").save_session_json(spoilt)
    recording(None).seal_earlier_sessions()
    assert sessions(tmp_path)["mud"].state == "sealed"


def test_every_stream_is_kept_while_a_session_cannot_be_read(
    tmp_path: Path, journal: NodeJournal, recording: Recording
) -> None:
    first = recording()
    stream_id = stream(1).stream_id
    first.add_stream(journal.switch_to_new_stream(stream(1)))
    (begun,) = sessions(tmp_path).values()
    folder = SessionsFolder(tmp_path / "sessions")
    (folder.get_path(begun.id) / "session.json").write_bytes(b"{")
    with pytest.raises(FileFormatError):
        folder.load(begun.id)
    recording(None)
    assert journal.retention_requests.node_session_numbers_of(stream_id).number_count > 10**9

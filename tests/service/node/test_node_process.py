"""`foottile node` as a process, with emulated tiles, against a real server."""

from __future__ import annotations

import json
import os
import pty
import signal
import tty
from collections.abc import Callable
from contextlib import closing
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.flags import FrameFlag, TileFlag
from devices.frames import NO_SERVO_COUNTS
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.journal.node.in_flight import read_in_flight_of_this_boot
from storage.journal.stream_notes import StreamNotes
from tests.service.cli.outcome import static_only
from tests.service.process import Start, acquisition_of, has_ended
from tests.service.running import Running
from tests.waiting import until

pytestmark = pytest.mark.real_time


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """The built-in scene with a calibration that need not be pressed on the bench first."""
    text = (resources.files("devices.scene") / "builtin" / "standing.toml").read_text("utf-8")
    path = tmp_path / "standing.toml"
    path.write_text('calibration = "paper-eq2-shape"\n' + static_only(text))
    return path


def test_an_emulated_node_streams_tares_and_ends_without_loss(
    running: Running, foottile: Start, scene: Path
) -> None:
    process = foottile("node", "--scene", scene, "--server", running.url, "--name", "demo")
    process.said("connected to")
    until(lambda: (running.node("demo")["last_seq"] or 0) > 600)
    until(lambda: running.node("demo")["tare"])
    node = running.node("demo")
    assert node["emulated"] is True
    assert node["tare"]["source"] == "lead"
    assert node["calibration"]["name"] == "paper-eq2-shape"
    assert node["calibration"]["absolute_scale"] == "assumed"
    assert node["rate_hz"] > 100.0
    assert node["lost_frames"] == 0
    assert node["clock"] is not None
    process.process.send_signal(signal.SIGTERM)
    assert process.ended() == 0, process.err
    assert not any("wait on this disk" in line for line in process.err)
    until(lambda: not running.node("demo")["connected"])
    node = running.node("demo")
    seqs = np.concatenate(
        [b.seq for b in running.journal(node["stream_id"], "demo").read_frames(0, 2**61)]
    )
    np.testing.assert_array_equal(seqs, np.arange(node["last_seq"] + 1))


@pytest.mark.slow
def test_a_servo_that_is_silent_from_the_start_is_said_and_the_tiles_stream(
    running: Running, foottile: Start, scene: Path
) -> None:
    master, slave = pty.openpty()
    try:
        tty.setraw(slave)
        servo = f'\n[servo]\nport = "{os.ttyname(slave)}"\nprotocol = 1\nmodel = "MX-28"\n'
        scene.write_text(scene.read_text() + servo)
        process = foottile("node", "--scene", scene, "--server", running.url, "--name", "mute")
        process.said("servo 1 at 1000000 baud, protocol 1: no answer within 100 ms")
        process.said("connected to")
        until(lambda: (running.node("mute")["last_seq"] or 0) > 100)
        process.process.send_signal(signal.SIGTERM)
        assert process.ended() == 0, process.err
    finally:
        os.close(master)
        os.close(slave)
    stream_id = running.node("mute")["stream_id"]
    batches = list(running.journal(stream_id, "mute").read_frames(0, 2**61))
    assert all((b.frame_flags & FrameFlag.SERVO_STALE).all() for b in batches)
    assert all((b.servo_counts == NO_SERVO_COUNTS).all() for b in batches)


@pytest.mark.slow
def test_a_tile_that_does_not_answer_is_named(
    running: Running, foottile: Start, scene: Path
) -> None:
    fault = '\n[[fault]]\ntile = "T03"\nkind = "no_answer"\nt_s = 0.0\nduration_s = 1000.0\n'
    scene.write_text(scene.read_text() + fault)
    process = foottile("node", "--scene", scene, "--server", running.url)
    assert process.ended() == 1
    assert any("T03" in line for line in process.err), process.err
    assert not any("Traceback" in line for line in process.err)


@pytest.mark.slow
def test_acquisition_ends_when_its_node_is_killed(
    running: Running, foottile: Start, scene: Path
) -> None:
    process = foottile("node", "--scene", scene, "--server", running.url, "--name", "demo")
    process.said("connected to")
    child = acquisition_of(process)
    os.kill(process.pid, signal.SIGKILL)
    # Its pipes stay open as long as a child has them: that they end is what is waited for.
    until(lambda: has_ended(child))
    assert process.ended() == -signal.SIGKILL
    until(lambda: not running.node("demo")["connected"])


@pytest.mark.slow
def test_a_node_without_a_server_keeps_its_frames(
    running: Running, foottile: Start, scene: Path, tmp_path: Path
) -> None:
    running.stop()
    process = foottile(
        *("node", "--scene", scene, "--server", running.url, "--name", "leg"),
        *("--journal", tmp_path / "node"),
    )
    assert "trying again" in process.said("not connected to")
    until(lambda: list((tmp_path / "node").glob("journal/leg/*/*.arrows")))
    process.process.send_signal(signal.SIGINT)
    assert process.ended() == 0  # no session needs them
    (folder,) = (tmp_path / "node" / "journal" / "leg").glob("?" * 32)
    notes = StreamNotes.load(folder)
    assert notes is not None
    with closing(Journal.open_existing_and_recover(folder)) as journal:
        assert journal.stored == Intervals([(0, (notes.next_seq or 0) - 1)])


@pytest.fixture
def leg(running: Running, foottile: Start, scene: Path, tmp_path: Path) -> Callable[..., Any]:
    """A node with a journal that outlives it."""

    def start(*arguments: object) -> Any:
        return foottile(
            *("node", "--scene", scene, "--name", "leg", "--journal", tmp_path / "node"),
            *(arguments or ("--server", running.url)),
        )

    return start


def streaming(running: Running, more: int = 100) -> dict[str, Any]:
    """Wait until the server has seen this many frames of the node's present stream."""
    until(lambda: running.http.get("/nodes/leg").status_code == 200)
    until(lambda: running.node("leg")["connected"])
    until(lambda: (running.node("leg")["last_seq"] or 0) > more)
    node: dict[str, Any] = running.node("leg")
    return node


def test_a_killed_node_has_lost_nothing_and_its_session_goes_on(
    running: Running, leg: Callable[..., Any]
) -> None:
    process = leg()
    before = streaming(running)
    session = running.record("leg", name="killed")
    until(lambda: running.node("leg")["last_seq"] > before["last_seq"] + 200)
    seen = running.node("leg")["last_seq"]
    process.process.kill()
    until(lambda: not running.node("leg")["connected"])
    again = leg()
    until(lambda: running.node("leg")["stream_id"] != before["stream_id"])
    streaming(running)
    session.stop()
    found = session.sealed()
    assert (found["complete"], len(found["parts"])) == (True, 2)
    assert found["parts"][0]["seq_last"] >= seen
    again.process.send_signal(signal.SIGTERM)
    assert again.ended() == 0, again.err


@pytest.mark.slow
def test_a_node_whose_own_files_are_damaged_starts_says_so_and_loses_no_more_than_it_says(
    running: Running, leg: Callable[..., Any], tmp_path: Path
) -> None:
    process = leg()
    before = streaming(running)
    session = running.record("leg", name="damaged")
    own = tmp_path / "node" / "journal" / "leg"
    until((own / "retention.json").exists)
    until(lambda: running.node("leg")["last_seq"] > before["last_seq"] + 200)
    process.process.kill()
    process.ended()
    until(lambda: not running.node("leg")["connected"])
    arrived = running.node("leg")["last_seq"]
    stream = own / before["stream_id"]
    left = read_in_flight_of_this_boot(stream)
    assert left is not None
    assert left[1] is not None
    taken = int(left[1].seq[-1])
    (own / "retention.json").write_bytes(b"")
    os.truncate(stream / "stream.json", 40)
    (stream / "in_flight").unlink()
    (stream / "in_flight").symlink_to("/dev/zero")
    again = leg()
    for name in ("retention.json", "stream.json", "in_flight"):
        again.said(f"{name}.damaged-1")
    until(lambda: running.node("leg")["stream_id"] != before["stream_id"])
    streaming(running)
    until(lambda: "retention.json" in " ".join(running.node("leg")["warnings"]))
    session.stop()
    found = session.sealed()
    first, second = session.ledger()["parts"]
    for part in (first, second):
        assert (part["recorded"], part["lost"]) == (part["seq_last"] - part["seq_first"] + 1, {})
    # What was in flight only is lost, and how much that may be is said.
    assert taken >= first["seq_last"] >= arrived
    assert (
        taken - first["seq_last"] <= first["max_lost_tail_frames"] == found["max_lost_tail_frames"]
    )
    assert second["max_lost_tail_frames"] == 0
    again.process.send_signal(signal.SIGTERM)
    assert again.ended() == 0, again.err


@pytest.mark.slow
def test_frames_of_a_session_wait_on_the_nodes_disk_until_both_are_back(
    running: Running, leg: Callable[..., Any], tmp_path: Path
) -> None:
    process = leg()
    streaming(running)
    session = running.record("leg", name="apart")
    # A server that is stopped before it has told the node leaves it with frames that nobody wants.
    told = tmp_path / "node" / "journal" / "leg" / "retention.json"
    until(lambda: told.exists() and running.node("leg")["stream_id"] in told.read_text())
    running.stop()
    process.said("not connected to")
    process.process.send_signal(signal.SIGINT)
    assert process.ended() == 3
    assert any("wait on this disk" in line for line in process.err)
    running.start()
    assert session.stop()["state"] == "pending"
    again = leg()
    assert session.sealed()["complete"] is True
    again.process.send_signal(signal.SIGTERM)
    assert again.ended() == 0, again.err


@pytest.mark.slow
def test_a_node_alone_leaves_a_complete_session_that_proves_itself(
    leg: Callable[..., Any], foottile: Start, tmp_path: Path
) -> None:
    process = leg("--record", "third trial")
    until(lambda: list((tmp_path / "node").glob("journal/leg/*/*.arrows")))
    process.process.kill()  # the battery held, the process did not
    process.ended()
    again = leg("--record", "third trial")
    again.said("goes on")
    until(lambda: len(list((tmp_path / "node").glob("journal/leg/*/*.arrows"))) > 1)
    again.process.send_signal(signal.SIGINT)
    assert again.ended() == 0, again.err
    assert "is complete" in again.said("session")
    proof = foottile("verify", tmp_path / "node", "--json")
    assert proof.ended() == 0, (proof.out, proof.err)
    (session,) = json.loads("".join(proof.out))["sessions"]
    assert (session["complete"], len(session["parts"])) == (True, 2)


@pytest.mark.slow
def test_a_part_that_is_swapped_begins_a_new_stream_and_loses_nothing_of_the_old_one(
    running: Running, foottile: Start, scene: Path
) -> None:
    swap = '\n[[fault]]\nkind = "replaced"\ntile = "T02"\nt_s = 6.0\nduration_s = 0.5\n'
    scene.write_text(scene.read_text() + swap)
    process = foottile("node", "--scene", scene, "--server", running.url, "--name", "demo")
    process.said("connected to")
    until(lambda: running.node("demo")["tare"])
    session = running.record("demo", name="swap")
    process.said("a new stream begins")
    sealed = session.sealed()
    assert sealed["complete"] is True
    assert "other tiles" in sealed["problem"]
    first = session.frames()
    tile = first.tile_flags[-20:, 1]
    assert (tile & TileFlag.UNUSABLE != 0).all(), "of the other part nothing was believed"
    assert (first.tile_flags[:, 0] & TileFlag.UNUSABLE == 0).all()
    until(lambda: (running.node("demo")["last_seq"] or 0) > 200)
    second = running.only_session(but=session)
    assert (second["name"], second["state"]) == ("swap (2)", "recording")
    second.stop()
    second.sealed()
    again = second.frames()
    assert again.frame_flags[0] & FrameFlag.NEW_ARRAY_INFO
    assert not (again.frame_flags[1:] & FrameFlag.NEW_ARRAY_INFO).any()
    assert (again.tile_flags[20:, 1] & TileFlag.UNUSABLE == 0).mean() > 0.99


@pytest.mark.slow
def test_a_tile_that_dies_is_named_on_the_terminal_and_by_the_server_and_so_is_its_return(
    running: Running, foottile: Start, scene: Path
) -> None:
    death = '\n[[fault]]\nkind = "unplugged"\ntile = "T03"\nt_s = 1.0\nduration_s = 2.5\n'
    scene.write_text(scene.read_text() + death)
    process = foottile("node", "--scene", scene, "--server", running.url)
    process.said("tile T03 (mux 0x70 channel 2) does not answer")
    (name,) = [node["node"] for node in running.http.get("/nodes").json()["items"]]
    until(lambda: running.node(name)["warnings"])
    assert running.node(name)["warnings"] == ["tile T03 (mux 0x70 channel 2) does not answer"]
    process.said("no longer: tile T03")
    until(lambda: not running.node(name)["warnings"])
    counts = running.node(name)["fault_counts"]
    assert counts["T03"]["no_answer"] > 100
    process.process.send_signal(signal.SIGTERM)
    assert process.ended() == 0

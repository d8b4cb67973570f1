"""Edges of a sync line, and the line of a recording, in `foottile node` on a chip of files."""

from __future__ import annotations

import csv
import json
import os
import signal
import time
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from storage.sessions.folder import SessionsFolder
from storage.sessions.metadata import read_existing_markers
from storage.sessions.reader import SealedFileReader
from tests.devices.array.gpio_chip import FileChip
from tests.service.cli.outcome import static_only
from tests.service.process import Start, acquisition_of
from tests.service.recording import Recording
from tests.service.running import Running
from tests.waiting import until

pytest.importorskip("gpiod", reason="sync lines need the extra `gpio`")
pytestmark = [pytest.mark.real_time, pytest.mark.slow]

BOUND_NS = 200_000


@pytest.fixture
def chip(tmp_path: Path) -> FileChip:
    return FileChip(tmp_path / "gpiochip")


@pytest.fixture
def leg(foottile: Start, tmp_path: Path, chip: FileChip) -> Callable[..., Any]:
    """A node with sync lines."""
    text = (resources.files("devices.scene") / "builtin" / "standing.toml").read_text("utf-8")
    sync = f'[sync]\ngpiochip = "{chip.path}"\ninput_line = 17\noutput_line = 27\nedge = "both"\n'
    scene = tmp_path / "scene.toml"
    scene.write_text('calibration = "paper-eq2-shape"\n' + static_only(text) + "\n" + sync)

    def start(*arguments: object, **keys: str) -> Any:
        for name, value in keys.items():
            scene.write_text(scene.read_text() + f'{name} = "{value}"\n')
        return foottile(
            *("node", "--scene", scene, "--name", "leg", "--journal", tmp_path / "node"),
            *arguments,
            **chip.environment,
        )

    return start


def labels_of(session: Recording) -> list[tuple[str, int]]:
    markers = session.running.http.get(f"{session.url}/markers").json()["items"]
    return [(marker["label"], marker["t_mono_ns"]) for marker in markers]


def test_edges_of_a_killed_node_and_of_a_lost_link_are_in_the_session_once(
    running: Running, leg: Callable[..., Any], chip: FileChip
) -> None:
    process = leg("--server", running.url)
    until(lambda: running.http.get("/nodes/leg").status_code == 200)
    until(lambda: (running.node("leg")["last_seq"] or 0) > 100)
    assert not chip.is_high(27)
    chip.send_edge()  # before the session
    time.sleep(1.0)
    session = running.record("leg", name="trial")
    until(lambda: chip.is_high(27))
    time.sleep(0.1)
    sent = [("sync rising", chip.send_edge()), ("sync falling", chip.send_edge(is_rising=False))]
    until(lambda: labels_of(session) == sent)
    running.stop()
    sent += [("sync rising", chip.send_edge())]
    time.sleep(0.3)
    assert chip.is_high(27), "a lost link ends no recording"
    os.kill(acquisition_of(process), signal.SIGSTOP)
    os.kill(acquisition_of(process), signal.SIGCONT)
    sent += [("sync falling", chip.send_edge(is_rising=False))]
    time.sleep(0.1)
    process.process.kill()
    process.ended()
    running.start()
    again = leg("--server", running.url)
    until(lambda: labels_of(session)[:2] == sent[:2])
    until(lambda: running.node("leg")["connected"])
    until(lambda: len(session.now()["parts"]) == 2)
    until(lambda: (running.node("leg")["last_seq"] or 0) > 100)
    sent += [("sync rising", chip.send_edge())]
    until(lambda: labels_of(session)[-1:] == sent[-1:])
    time.sleep(0.1)
    session.stop()
    found = session.sealed()
    assert labels_of(session) == sent
    assert (found["complete"], found["problem"]) == (True, None)
    markers = read_existing_markers(session.folder / "markers.parquet")
    assert all(m.bound_ns is not None and BOUND_NS < m.bound_ns < 1e9 for m in markers)
    rows = list(csv.DictReader(session.data(format="csv").text.splitlines()))
    labels = [label for row in rows if row["marker"] for label in row["marker"].split("; ")]
    assert labels == [label for label, _ in sent]
    until(lambda: not chip.is_high(27))
    again.process.send_signal(signal.SIGTERM)
    assert again.ended() == 0, again.err


@pytest.mark.parametrize("is_killed", [False, True])
def test_a_node_alone_has_its_edges_in_its_session(
    leg: Callable[..., Any], foottile: Start, chip: FileChip, tmp_path: Path, is_killed: bool
) -> None:
    process = leg("--record", "trial")
    until(lambda: list((tmp_path / "node").glob("journal/leg/*/*.arrows")))
    assert chip.is_high(27)
    time.sleep(0.5)
    sent = [chip.send_edge(), chip.send_edge(lost_before=3)]
    time.sleep(0.1)
    if is_killed:
        process.process.kill()
        process.ended()
        assert foottile("recover", tmp_path / "node").ended() == 0
    else:
        process.process.send_signal(signal.SIGTERM)
        assert process.ended() == 0, process.err
        assert not chip.is_high(27)
    (folder,) = (tmp_path / "node" / "sessions").iterdir()
    markers = read_existing_markers(folder / "markers.parquet")
    assert [(m.t_mono_ns, m.bound_ns) for m in markers] == [(t, None) for t in sent]
    session = SessionsFolder(folder.parent).load(folder.name)
    assert session.problem is not None
    assert "3 edges of the sync line are lost" in session.problem
    assert session.vitals_at_start is not None
    assert session.vitals_at_start.disk_free_bytes
    assert (session.vitals_at_stop is None) == is_killed
    proof = foottile("verify", tmp_path / "node", "--json")
    assert proof.ended() == 0, (proof.out, proof.err)
    export = foottile(
        "export", folder / "frames.parquet", "--format", "csv", "--out", tmp_path / "x.csv"
    )
    assert export.ended() == 0, export.err
    with (tmp_path / "x.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["marker"]]
    labels = [label for row in rows for label in row["marker"].split("; ")]
    assert labels == ["sync rising"] * 2
    for t_ns, row in zip(sent, (rows * 2)[:2], strict=True):
        assert abs(int(row["t_mono_ns"]) - t_ns) < 20e6


def test_a_film_of_the_lamp_of_a_node_is_aligned_with_its_session(
    leg: Callable[..., Any], chip: FileChip, tmp_path: Path
) -> None:
    pytest.importorskip("av", reason="films need the extra `video`")
    from service.video.methods import align_video
    from studies.reproduce.leg_film import Camera
    from tests.service.video.test_methods import add_film

    process = leg("--record", "trial", output="code")
    until(lambda: chip.is_high(27), 90.0)
    time.sleep(10.0)
    process.process.send_signal(signal.SIGTERM)
    assert process.ended() == 0, process.err
    (session,) = (tmp_path / "node" / "sessions").iterdir()
    switched_ns, levels = map(np.array, zip(*chip.read_levels(27), strict=True))
    begin_ns = int(switched_ns[levels][0]) - 1_234_567_890
    camera = Camera(width=96, height=64)
    pictures = []
    for index in range(500):
        at_ns = begin_ns + index * 20_000_000 + np.arange(0, 6_000_000, 500_000)
        rows = np.searchsorted(switched_ns, at_ns, side="right") - 1
        picture = np.full((64, 96), 90.0)
        picture[16:32, 32:48] += 60.0 * np.mean(levels[np.maximum(rows, 0)] & (rows >= 0))
        pictures.append(picture.astype(np.uint8))
    found = align_video(session, add_film(session, camera, pictures).id, "light").alignment
    assert found is not None
    with SealedFileReader(session / "frames.parquet") as reader:
        off_ns = found.t_ns + found.to_session_ns(np.array([0.0]))[0] - reader.info.utc_offset_ns
    is_late = any("the lamp is switched late" in line for line in process.err)
    assert abs(off_ns - begin_ns - 3_000_000) < (10e6 if not is_late else 40e6)


def test_a_chip_that_is_not_there_is_said_at_the_start(
    leg: Callable[..., Any], chip: FileChip
) -> None:
    (chip.path / "line17").unlink()
    process = leg("--record", "trial")
    assert process.ended() == 1
    assert any("lines 17: GPIO lines cannot be used" in line for line in process.err), process.err
    assert json.dumps(process.err).count("Check [sync]") == 1

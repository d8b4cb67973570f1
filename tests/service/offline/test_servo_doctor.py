"""Which servo is found, and how patiently it is asked for."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import pytest

from devices.buses.serial_line import open_serial_line
from devices.clock import VirtualClock
from devices.scene.scene_file import load_scene
from service.offline import doctor
from service.offline.doctor import diagnose_servo
from tests.builders.servo import FaultyServo


@pytest.mark.real_time
def test_an_answer_that_a_busy_machine_hears_late_is_still_an_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wanted = load_scene("rolling").servo
    monkeypatch.setattr(doctor, "TIMEOUTS_S", (0.01, 1.0))
    # One rate: what is said at others comes after the answer to the first.
    monkeypatch.setattr(doctor, "BAUDRATES", ())
    with FaultyServo(lambda _: 0, VirtualClock(), model="MX-28") as servo, servo.late(0.05):
        diagnosis = diagnose_servo(servo.port, VirtualClock(), wanted)
    assert [found.model for found in diagnosis.found] == ["MX-28"]
    assert diagnosis.is_well


def test_a_silent_servo_is_not_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "TIMEOUTS_S", (0.01, 0.02))
    with FaultyServo(lambda _: 0, VirtualClock()) as servo, servo.silent():
        diagnosis = diagnose_servo(servo.port, VirtualClock(), None)
    assert not diagnosis.is_well
    assert "No servo answers as id 1" in diagnosis.verdict


def test_a_port_that_is_not_there_is_a_finding_and_no_failure_of_the_doctor(tmp_path: Path) -> None:
    diagnosis = diagnose_servo(str(tmp_path / "ttyUSB0"), VirtualClock(), None)
    assert not diagnosis.is_well
    assert diagnosis.found == ()
    assert "No such file" in diagnosis.verdict
    assert "group dialout" in diagnosis.verdict


def test_the_process_that_holds_a_busy_port_is_named() -> None:
    with (
        FaultyServo(lambda _: 0, VirtualClock()) as servo,
        contextlib.closing(open_serial_line(servo.port, 57_600, 0.02)),
    ):
        diagnosis = diagnose_servo(servo.port, VirtualClock(), None)
    assert not diagnosis.is_well
    assert f"(process {os.getpid()})" in diagnosis.verdict

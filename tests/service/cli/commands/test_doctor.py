"""`foottile doctor`: what it finds on an emulated bus, what it advises, and its exit codes."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from devices.scene.scene_file import load_scene
from tests.service.cli.outcome import Outcome, Run, faulty, scene_text

Doctor = Callable[..., Outcome]


@pytest.fixture
def doctor(run: Run, tmp_path: Path) -> Doctor:
    """Run the doctor with --json on a scene of this text."""

    def examine(text: str, *arguments: object) -> Outcome:
        (tmp_path / "scene.toml").write_text(text)
        return run("doctor", "--scene", "scene.toml", "--json", *arguments)

    return examine


def test_a_healthy_bus_is_reported_with_its_rates(run: Run) -> None:
    found = run("doctor", "--bus", "emulated", "--json").printed()
    assert [tile["serial"] for tile in found["tiles"]] == ["T01", "T02", "T03", "T04"]
    assert all(tile["problem"] == "" for tile in found["tiles"])
    # The scene's parts take 1.6 ms; hardware.md 4 has the rates.
    assert all(1.6 <= tile["conversion_ms"] < 1.62 for tile in found["tiles"])
    assert found["scl_hz"] == pytest.approx(400_000, rel=1e-3)
    limits = {"sequential": 132.45, "simultaneous": 394.87, "pipelined": 544.22}
    for schedule, limit_hz in limits.items():
        assert 0.99 * limit_hz < found["rates_hz"][schedule] <= limit_hz
    assert found["schedule"] == "pipelined"
    assert "pipelined gives 541 frames/s" in found["verdict"]
    assert "repeated" not in found["verdict"], "channels without a tile are no disturbance"


def test_the_text_has_the_same_figures(run: Run) -> None:
    outcome = run("doctor", "--bus", "emulated")
    assert outcome.code == 0
    for word in ("T03", "0x70", "1.609 ms", "400.0 kHz", "541.5", "best", "pipelined gives"):
        assert word in outcome.out


def test_a_rate_beyond_the_bus_gets_a_lower_one(run: Run) -> None:
    found = run("doctor", "--scene", "standing", "--rate-hz", 700, "--json").printed(3)
    assert found["holds"] is False
    assert "700 frames/s requested will not hold: ask for 531 or less" in found["verdict"]


def test_a_rate_for_another_schedule_gets_the_name_of_this_schedule(doctor: Doctor) -> None:
    text = scene_text("standing").replace("[array]", '[array]\nschedule = "sequential"')
    found = doctor(text, "--rate-hz", 300).printed(3)
    assert "will not hold: use schedule simultaneous" in found["verdict"]


def test_the_raspberry_pi_that_runs_at_five_eighths_is_recognised(doctor: Doctor) -> None:
    found = doctor(scene_text("standing") + "\n[emulation]\nscl_part = 0.625\n").printed()
    assert found["scl_hz"] == pytest.approx(250_000, rel=1e-3)
    assert "runs at 250 kHz where 400 are requested" in found["verdict"]
    assert "core_freq" in found["verdict"]


def test_a_slow_part_is_named_with_its_cost(run: Run) -> None:
    outcome = run("doctor", "--scene", "rolling", "--servo", "none", "--json")
    slowest = max(outcome.printed()["tiles"], key=lambda tile: tile["conversion_ms"])
    assert f"{slowest['serial']} converts slowest" in json.loads(outcome.out)["verdict"]


@pytest.mark.parametrize("kind", ["no_answer", "unplugged"])
def test_a_tile_that_is_not_there_needs_attention(doctor: Doctor, kind: str) -> None:
    found = doctor(scene_text("standing") + faulty(kind, tile="T02")).printed(3)
    assert [tile["serial"] for tile in found["tiles"] if tile["problem"]] == ["T02"]
    assert "T02 needs attention first" in found["verdict"]
    assert found["rates_hz"]["pipelined"] is not None, "the others are measured all the same"


def test_a_part_that_does_not_convert_needs_attention_and_sets_no_rate(doctor: Doctor) -> None:
    found = doctor(scene_text("standing") + faulty("stale", tile="T03")).printed(3)
    (tile,) = [tile for tile in found["tiles"] if tile["problem"]]
    assert (tile["serial"], tile["conversion_ms"]) == ("T03", None)
    assert "never change" in tile["problem"]
    assert "converts slowest" not in found["verdict"]


def test_a_silent_bus_is_a_failure_with_advice(doctor: Doctor) -> None:
    found = doctor(scene_text("standing") + faulty("sda_high")).printed(1)
    assert found["scl_hz"] is None
    assert "Nothing answers at 0x70 to 0x77" in found["verdict"]


@pytest.mark.parametrize(("kind", "word"), [("sda_low", "SDA is stuck low"), ("scl_low", "bus")])
def test_a_stuck_bus_is_a_failure_in_one_line(doctor: Doctor, kind: str, word: str) -> None:
    outcome = doctor(scene_text("standing") + faulty(kind))
    assert outcome.code == 1
    assert outcome.out == ""
    assert outcome.err.startswith("foottile: ")
    assert word in outcome.err
    assert "Traceback" not in outcome.err


@pytest.mark.slow
def test_more_channels_than_allowed_at_once_is_no_schedule(run: Run) -> None:
    found = json.loads(run("doctor", "--scene", "grid", "--json").out)
    assert found["rates_hz"]["simultaneous"] is None
    assert found["schedule"] == "per_mux"
    assert len(found["tiles"]) == len(load_scene("grid").tile) == 64


@pytest.mark.real_time
def test_the_servo_of_the_scene_is_found_and_named(run: Run) -> None:
    found = json.loads(run("doctor", "--scene", "rolling", "--json").out)["servo"]
    assert found["is_well"] is True
    assert found["verdict"].startswith("MX-28, protocol 2, 1000000 baud, id 1.")


@pytest.mark.real_time
def test_a_servo_that_differs_from_the_scene_is_named(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from devices.clock import SystemClock
    from devices.emulation.chips.dynamixel import EmulatedServo

    with EmulatedServo(lambda _: 0, SystemClock(), protocol=1, model="MX-64") as servo:
        outcome = run("doctor", "--scene", "rolling", "--servo", servo.port, "--json")
    found = outcome.printed(3)["servo"]
    assert "MX-64, protocol 1" in found["verdict"]
    assert "The scene says MX-28, protocol 2" in found["verdict"]


def test_a_servo_without_its_port_does_not_hide_the_tiles(run: Run) -> None:
    found = run("doctor", "--scene", "rolling", "--servo", "/dev/ttyUSB99", "--json").printed(3)
    assert found["scl_hz"] is not None
    assert found["servo"]["is_well"] is False
    assert "No such file" in found["servo"]["verdict"]


def test_a_wait_that_the_scene_fixes_is_the_one_that_counts(doctor: Doctor) -> None:
    text = scene_text("standing").replace("[array]", "[array]\nwait_ms = 3.0")
    found = json.loads(doctor(text).out)
    assert found["rates_hz"]["pipelined"] == pytest.approx(309.0, rel=0.005)  # hardware.md 4


def test_beside_a_reference_sensor_tiles_are_asked_at_once(run: Run) -> None:
    verdict = json.loads(run("doctor", "--scene", "indentation", "--json").out)["verdict"]
    assert "simultaneous gives" in verdict


def test_single_lost_acknowledges_do_not_make_tiles_look_ill(doctor: Doctor) -> None:
    found = doctor(scene_text("standing") + faulty("nack_storm", rate=0.002)).printed()
    assert not any(tile["problem"] for tile in found["tiles"])
    assert re.search(r"\d+ transfers were acknowledged only when repeated", found["verdict"])


def test_a_bus_that_hangs_since_the_last_run_is_freed_or_named_and_no_tile_is_blamed(
    run: Run, tmp_path: Path
) -> None:
    simulate = ("simulate", "--scene", "scene.toml", "--seconds", 1, "--no-estimates")
    hanging = scene_text("standing") + faulty("sda_low")
    (tmp_path / "scene.toml").write_text(hanging + "\n[recovery]\nreset_line = 17\n")
    run(*simulate).succeeds()
    (tmp_path / "scene.toml").write_text(hanging)
    outcome = run(*simulate)
    outcome.fails(1, "SDA is stuck low")
    assert "T01" not in outcome.err


def bmp581_text(tiles: int, **keys: object) -> str:
    """Return the text of a scene of the grid's first tiles, of the chip BMP581."""
    head, *sections = scene_text("grid").split("[[tile]]")
    sections[-1], behind = sections[-1].split("\n[", 1)
    lines = [f"{key} = {json.dumps(value)}" for key, value in {"chip": "bmp581", **keys}.items()]
    own = ["\n".join(["[[tile]]", *lines, each]) for each in sections[:tiles]]
    return "".join([head, *own, "\n[", behind])


@pytest.mark.parametrize(
    ("tiles", "keys", "rate_hz", "advice"),
    [
        (4, {}, 490, ""),
        (4, {"oversampling": 8}, 153, "oversampling = 1: 490 frames/s"),
        (8, {}, 267, "oversampling = 4: 251 frames/s"),
        (8, {"oversampling": 4}, 251, ""),
        (8, {"mode": "forced"}, 258, ""),
        (16, {"oversampling": 8}, 149, ""),
        pytest.param(64, {}, 6.2, "oversampling = 32: 36 frames/s", marks=pytest.mark.slow),
    ],
)
def test_tiles_with_settings_are_examined_with_them_and_better_ones_are_advised(
    doctor: Doctor, tiles: int, keys: dict[str, object], rate_hz: float, advice: str
) -> None:
    found = doctor(bmp581_text(tiles, **keys)).printed()
    assert len(found["tiles"]) == tiles
    assert found["rates_hz"]["pipelined"] == pytest.approx(rate_hz, rel=0.02)
    assert advice in found["verdict"]
    assert ("Set oversampling" in found["verdict"]) == bool(advice)
    assert "repeated" not in found["verdict"], "a part in its reset is no disturbance"


def test_a_requested_rate_leaves_time_for_more_samples(doctor: Doctor) -> None:
    verdict = doctor(bmp581_text(4), "--rate-hz", 100).printed()["verdict"]
    assert "Set oversampling = 8: 153 frames/s" in verdict


def test_a_clock_beyond_the_multiplexers_is_named(doctor: Doctor) -> None:
    text = bmp581_text(4) + "\n[array]\nscl_hz = 1000000\n"
    assert "rated for 400 kHz only" in doctor(text).printed()["verdict"]

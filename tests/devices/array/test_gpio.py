"""GPIO lines of the recovery: the calls of libgpiod and pinctrl. No test has touched a pin."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path
from typing import Any, Self

import pytest

from devices.array.bus_recovery import GpioLines, GpioRecovery, open_gpio_recovery
from devices.clock import VirtualClock
from devices.errors import BusSetupError, MissingExtraError
from devices.scene.hardware_sections import RecoverySection

pytestmark = pytest.mark.process

gpiod = pytest.importorskip("gpiod", reason="GPIO lines need the extra `gpio`")
ACTIVE, INACTIVE = gpiod.line.Value.ACTIVE, gpiod.line.Value.INACTIVE


class Request:
    """`gpiod.LineRequest` on pins that no other device pulls low."""

    def __init__(self, lines: tuple[int, ...], failure: OSError | None) -> None:
        self.lines = lines
        self.is_open = True
        self.moves: list[tuple[int, Any]] = []
        self.values = dict.fromkeys(lines, ACTIVE)
        self.failure = failure

    def set_value(self, line: int, value: Any) -> None:
        assert self.is_open
        if self.failure is not None:
            raise self.failure
        self.moves.append((line, value))
        self.values[line] = value

    def get_value(self, line: int) -> Any:
        assert self.is_open
        return self.values[line]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.is_open = False


class Pi:
    """A machine with GPIO lines and a `pinctrl` that records its arguments."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.requests: list[Request] = []
        self.settings: list[tuple[str, str, Any]] = []
        self.refusal: OSError | None = None
        self.failure: OSError | None = None
        self.install("pinctrl")

    def install(self, tool: str, ending: str = "exit 0") -> None:
        path = self.folder / tool
        path.write_text(f'#!/bin/sh\necho "{tool} $*" >> "{self.folder}/calls"\n{ending}\n')
        path.chmod(0o755)

    @property
    def calls(self) -> list[str]:
        path = self.folder / "calls"
        return path.read_text().splitlines() if path.exists() else []

    def request_lines(self, path: str, *, consumer: str, config: dict[Any, Any]) -> Request:
        if self.refusal is not None:
            raise self.refusal
        ((lines, settings),) = config.items()
        self.settings.append((path, consumer, settings))
        self.requests.append(Request(lines, self.failure))
        return self.requests[-1]


@pytest.fixture
def pi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pi:
    pi = Pi(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("gpiod.request_lines", pi.request_lines)
    return pi


def test_lines_are_requested_open_drain_and_released_and_then_driven_and_read(pi: Pi) -> None:
    scene = RecoverySection(gpiochip="/dev/gpiochip4", scl_line=23, sda_line=22, i2c_function="a3")
    with GpioLines(scene).request_scl_sda() as (scl, sda):
        ((path, consumer, settings),) = pi.settings
        assert (path, consumer) == ("/dev/gpiochip4", "foottile")
        assert settings.direction is gpiod.line.Direction.OUTPUT
        assert settings.drive is gpiod.line.Drive.OPEN_DRAIN
        assert settings.output_value is ACTIVE
        assert pi.requests[0].moves == []
        scl.drive(low=True)
        assert (scl.is_high(), sda.is_high()) == (False, True)
        scl.drive(low=False)
        sda.drive(low=True)
        assert (scl.is_high(), sda.is_high()) == (True, False)
        assert pi.calls == []
    assert pi.requests[0].lines == (23, 22)
    assert pi.requests[0].moves == [(23, INACTIVE), (23, ACTIVE), (22, INACTIVE)]
    assert not pi.requests[0].is_open
    assert pi.calls == ["pinctrl set 22,23 a3"]


def test_pins_are_returned_to_the_controller_after_an_error(pi: Pi) -> None:
    with pytest.raises(ZeroDivisionError), GpioLines(RecoverySection()).request_scl_sda():
        _ = 1 / 0
    assert not pi.requests[0].is_open
    assert pi.calls == ["pinctrl set 2,3 a0"]


def test_an_older_system_returns_its_pins_with_raspi_gpio(pi: Pi) -> None:
    pi.install("raspi-gpio")
    for _ in range(2):
        with GpioLines(RecoverySection()).request_scl_sda():
            pass
        (pi.folder / "pinctrl").unlink(missing_ok=True)
    assert pi.calls == ["pinctrl set 2,3 a0", "raspi-gpio set 2,3 a0"]


def test_no_pin_is_requested_without_a_tool_to_return_it(pi: Pi) -> None:
    (pi.folder / "pinctrl").unlink()
    with pytest.raises(BusSetupError, match="no tool to give SDA and SCL back") as caught:
        open_gpio_recovery(RecoverySection(), VirtualClock())
    assert "pinctrl or raspi-gpio" in caught.value.expected
    assert pi.requests == []


def test_a_failed_return_of_pins_names_the_command_that_returns_them(pi: Pi) -> None:
    pi.install("pinctrl", "echo 'Failed to open gpiomem' >&2; exit 1")
    with pytest.raises(BusSetupError, match=r"still GPIO.*Failed to open gpiomem") as caught:
        open_gpio_recovery(RecoverySection(), VirtualClock())
    assert f"sudo {pi.folder}/pinctrl set 2,3 a0" in caught.value.remedy


def test_lines_in_use_are_refused_and_returned(pi: Pi) -> None:
    pi.refusal = OSError(errno.EBUSY, os.strerror(errno.EBUSY))
    with pytest.raises(BusSetupError, match="Device or resource busy") as caught:
        open_gpio_recovery(RecoverySection(), VirtualClock())
    assert caught.value.where == "/dev/gpiochip0, lines 3, 2"
    assert caught.value.errno == errno.EBUSY
    assert pi.calls == ["pinctrl set 2,3 a0"], "a line may be taken before the request failed"


def test_a_line_that_fails_while_it_is_driven_is_an_error_and_its_pins_are_returned(pi: Pi) -> None:
    pi.failure = OSError(errno.ENODEV, os.strerror(errno.ENODEV))
    with pytest.raises(BusSetupError, match="No such device") as caught:
        GpioRecovery(GpioLines(RecoverySection()), VirtualClock()).send_recovery_clocks()
    assert caught.value.__cause__ is pi.failure
    assert not pi.requests[0].is_open
    assert pi.calls == ["pinctrl set 2,3 a0"]


def test_the_extra_is_named_without_the_library(pi: Pi, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", None)
    with pytest.raises(MissingExtraError, match=r"'foottile\[gpio\]'"):
        open_gpio_recovery(RecoverySection(), VirtualClock())


def test_the_real_library_refuses_a_missing_chip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Pi(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BusSetupError, match="No such file") as caught:
        open_gpio_recovery(RecoverySection(gpiochip=str(tmp_path / "gpiochip9")), VirtualClock())
    assert caught.value.errno == errno.ENOENT


def test_opening_requests_every_line_once_and_drives_none(pi: Pi) -> None:
    recovery = open_gpio_recovery(RecoverySection(reset_line=17), VirtualClock())
    assert recovery is not None
    assert [request.lines for request in pi.requests] == [(3, 2), (17,)]
    assert all(request.moves == [] and not request.is_open for request in pi.requests)
    pi.requests.clear()
    called = len(pi.calls)
    assert recovery.reset_muxes()
    assert [request.moves for request in pi.requests] == [[(17, INACTIVE), (17, ACTIVE)]]
    assert len(pi.calls) == called, "RESET is no pin of the controller"
    assert recovery.send_recovery_clocks()
    stop = [(3, INACTIVE), (2, INACTIVE), (3, ACTIVE), (2, ACTIVE)]
    assert pi.requests[1].moves == stop, "a free bus gets a STOP"


def test_a_reset_line_that_is_not_wired_is_not_requested(pi: Pi) -> None:
    assert not GpioRecovery(GpioLines(RecoverySection()), VirtualClock()).reset_muxes()
    assert pi.requests == []

"""GPIO lines: what is asked of libgpiod and of pinctrl. Nothing here has touched a pin."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path
from typing import Any, Self

import pytest

from devices.clock import VirtualClock
from devices.errors import BusSetupError, MissingExtraError
from devices.recovery import GpioLines, GpioRecovery, open_gpio_recovery
from devices.scene.hardware_sections import RecoverySection

pytestmark = pytest.mark.process

gpiod = pytest.importorskip("gpiod", reason="lines of GPIO need the extra `gpio`")
ACTIVE, INACTIVE = gpiod.line.Value.ACTIVE, gpiod.line.Value.INACTIVE


class Request:
    """`gpiod.LineRequest` on pins that nobody else pulls low."""

    def __init__(self, lines: tuple[int, ...], failure: OSError | None) -> None:
        self.lines = lines
        self.held = True
        self.moves: list[tuple[int, Any]] = []
        self.values = dict.fromkeys(lines, ACTIVE)
        self.failure = failure

    def set_value(self, line: int, value: Any) -> None:
        assert self.held
        if self.failure is not None:
            raise self.failure
        self.moves.append((line, value))
        self.values[line] = value

    def get_value(self, line: int) -> Any:
        assert self.held
        return self.values[line]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.held = False


class Pi:
    """A machine with GPIO lines and a `pinctrl` that writes down its arguments."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.requests: list[Request] = []
        self.asked: list[tuple[str, str, Any]] = []
        self.refusal: OSError | None = None
        self.failure: OSError | None = None
        self.install("pinctrl")

    def install(self, tool: str, ending: str = "exit 0") -> None:
        path = self.folder / tool
        path.write_text(f'#!/bin/sh\necho "{tool} $*" >> "{self.folder}/said"\n{ending}\n')
        path.chmod(0o755)

    @property
    def said(self) -> list[str]:
        path = self.folder / "said"
        return path.read_text().splitlines() if path.exists() else []

    def request_lines(self, path: str, *, consumer: str, config: dict[Any, Any]) -> Request:
        if self.refusal is not None:
            raise self.refusal
        ((lines, settings),) = config.items()
        self.asked.append((path, consumer, settings))
        self.requests.append(Request(lines, self.failure))
        return self.requests[-1]


@pytest.fixture
def pi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pi:
    pi = Pi(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("gpiod.request_lines", pi.request_lines)
    return pi


def test_the_lines_are_open_drain_and_let_go_from_the_first_moment(pi: Pi) -> None:
    with GpioLines(RecoverySection(gpiochip="/dev/gpiochip4")).request_scl_sda():
        pass
    ((path, consumer, settings),) = pi.asked
    assert (path, consumer) == ("/dev/gpiochip4", "foottile")
    assert pi.requests[0].lines == (3, 2)
    assert settings.direction is gpiod.line.Direction.OUTPUT
    assert settings.drive is gpiod.line.Drive.OPEN_DRAIN
    assert settings.output_value is ACTIVE
    assert pi.requests[0].moves == []


def test_a_line_is_pulled_low_let_go_and_read(pi: Pi) -> None:
    with GpioLines(RecoverySection(scl_line=23, sda_line=22)).request_scl_sda() as (scl, sda):
        scl.drive(low=True)
        assert not scl.is_high()
        assert sda.is_high()
        scl.drive(low=False)
        sda.drive(low=True)
        assert scl.is_high()
        assert not sda.is_high()
    assert pi.requests[0].moves == [(23, INACTIVE), (23, ACTIVE), (22, INACTIVE)]


def test_the_pins_are_given_back_to_the_controller_after_they_are_released(pi: Pi) -> None:
    with GpioLines(RecoverySection()).request_scl_sda():
        assert pi.said == []
    assert not pi.requests[0].held
    assert pi.said == ["pinctrl set 2,3 a0"]


def test_on_a_pi_5_the_function_has_another_number(pi: Pi) -> None:
    with GpioLines(RecoverySection(i2c_function="a3")).request_scl_sda():
        pass
    assert pi.said == ["pinctrl set 2,3 a3"]


def test_the_pins_are_given_back_whatever_happens(pi: Pi) -> None:
    with pytest.raises(ZeroDivisionError), GpioLines(RecoverySection()).request_scl_sda():
        _ = 1 / 0
    assert not pi.requests[0].held
    assert pi.said == ["pinctrl set 2,3 a0"]


def test_an_older_system_has_an_older_tool(pi: Pi) -> None:
    pi.install("raspi-gpio")
    with GpioLines(RecoverySection()).request_scl_sda():
        pass
    (pi.folder / "pinctrl").unlink()
    with GpioLines(RecoverySection()).request_scl_sda():
        pass
    assert pi.said == ["pinctrl set 2,3 a0", "raspi-gpio set 2,3 a0"]


def test_without_a_tool_to_give_them_back_the_pins_are_not_taken(pi: Pi) -> None:
    (pi.folder / "pinctrl").unlink()
    with pytest.raises(BusSetupError, match="no tool to give SDA and SCL back") as caught:
        open_gpio_recovery(RecoverySection(), VirtualClock())
    assert "pinctrl or raspi-gpio" in caught.value.expected
    assert pi.requests == []


def test_pins_that_are_not_given_back_are_said_with_the_command_to_do_it(pi: Pi) -> None:
    pi.install("pinctrl", "echo 'Failed to open gpiomem' >&2; exit 1")
    with pytest.raises(BusSetupError, match=r"still GPIO.*Failed to open gpiomem") as caught:
        open_gpio_recovery(RecoverySection(), VirtualClock())
    assert f"sudo {pi.folder}/pinctrl set 2,3 a0" in caught.value.remedy


def test_lines_that_cannot_be_had_are_said(pi: Pi) -> None:
    pi.refusal = OSError(errno.EBUSY, os.strerror(errno.EBUSY))
    with pytest.raises(BusSetupError, match="Device or resource busy") as caught:
        open_gpio_recovery(RecoverySection(), VirtualClock())
    assert caught.value.where == "/dev/gpiochip0, lines 3, 2"
    assert caught.value.errno == errno.EBUSY
    assert pi.said == ["pinctrl set 2,3 a0"], "it may have been taken before it failed"


def test_a_line_that_fails_while_it_is_moved_is_said(pi: Pi) -> None:
    failure = OSError(errno.ENODEV, os.strerror(errno.ENODEV))
    pi.failure = failure
    with pytest.raises(BusSetupError, match="No such device") as caught:
        GpioRecovery(GpioLines(RecoverySection()), VirtualClock()).send_recovery_clocks()
    assert caught.value.__cause__ is failure
    assert pi.said == ["pinctrl set 2,3 a0"]


def test_without_the_library_the_extra_is_named(pi: Pi, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", None)
    with pytest.raises(MissingExtraError, match=r"'foottile\[gpio\]'"):
        open_gpio_recovery(RecoverySection(), VirtualClock())


def test_a_chip_that_is_not_there_is_said_by_the_real_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Pi(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BusSetupError, match="No such file") as caught:
        open_gpio_recovery(RecoverySection(gpiochip=str(tmp_path / "gpiochip9")), VirtualClock())
    assert caught.value.errno == errno.ENOENT


def test_opening_tries_every_line_once_and_moves_none(pi: Pi) -> None:
    recovery = open_gpio_recovery(RecoverySection(reset_line=17), VirtualClock())
    assert recovery is not None
    assert [request.lines for request in pi.requests] == [(3, 2), (17,)]
    assert all(request.moves == [] and not request.held for request in pi.requests)


def test_the_reset_line_is_pulsed_and_the_bus_left_alone(pi: Pi) -> None:
    recovery = GpioRecovery(GpioLines(RecoverySection(reset_line=17)), VirtualClock())
    assert recovery.reset_muxes()
    (request,) = pi.requests
    assert request.moves == [(17, INACTIVE), (17, ACTIVE)]
    assert pi.said == [], "it was never the controller's"


def test_a_reset_line_that_is_not_wired_is_not_moved(pi: Pi) -> None:
    assert not GpioRecovery(GpioLines(RecoverySection()), VirtualClock()).reset_muxes()
    assert pi.requests == []


def test_a_free_bus_is_clocked_out_through_the_lines(pi: Pi) -> None:
    assert GpioRecovery(GpioLines(RecoverySection()), VirtualClock()).send_recovery_clocks()
    assert pi.requests[0].moves == [(3, INACTIVE), (2, INACTIVE), (3, ACTIVE), (2, ACTIVE)]

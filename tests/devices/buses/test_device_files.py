"""Attempts to reopen a lost device: one a second, and no caller waits for them."""

from __future__ import annotations

import threading
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from devices.buses.device_files import ATTEMPT_INTERVAL_NS, DeviceReopener
from devices.errors import BusSetupError
from tests.waiting import until


class Device:
    """A device that can be missing, and that can block when it is opened."""

    def __init__(self) -> None:
        self.is_present = False
        self.answers = threading.Event()
        self.answers.set()
        self.attempts_ns: list[int] = []
        self.now_ns = 0
        self.closed = 0

    def open(self) -> Device:
        self.attempts_ns.append(self.now_ns)
        self.answers.wait()
        if not self.is_present:
            raise BusSetupError("not there", where="/dev/i2c-3", errno=2)
        return self

    def close(self) -> None:
        self.closed += 1


@given(
    steps_ns=st.lists(st.integers(0, 3 * ATTEMPT_INTERVAL_NS), max_size=60), back=st.integers(0, 60)
)
def test_a_device_is_reopened_by_one_attempt_a_second(steps_ns: list[int], back: int) -> None:
    device = Device()
    reopener = DeviceReopener(device.open, is_synchronous=True)
    for i, step_ns in enumerate(steps_ns):
        device.is_present = i >= back
        before = len(device.attempts_ns)
        device.now_ns += step_ns
        opened = reopener.poll_opened_device(device.now_ns)
        assert (opened is device) == (device.is_present and len(device.attempts_ns) > before)
        assert ("not there" in reopener.last_error) == (not device.is_present) or opened is None
    assert all(b - a >= ATTEMPT_INTERVAL_NS for a, b in pairwise(device.attempts_ns))
    if steps_ns:
        assert device.attempts_ns, "the first attempt is at once"


def test_an_opening_that_blocks_delays_no_caller_and_is_not_repeated() -> None:
    device = Device()
    device.is_present = True
    device.answers.clear()
    reopener = DeviceReopener(device.open)
    for now_ns in range(0, 5 * ATTEMPT_INTERVAL_NS, ATTEMPT_INTERVAL_NS // 10):
        assert reopener.poll_opened_device(now_ns) is None
    assert len(device.attempts_ns) == 1
    device.answers.set()
    assert until(lambda: reopener.poll_opened_device(5 * ATTEMPT_INTERVAL_NS)) is device


def test_a_device_opened_after_the_last_poll_is_closed() -> None:
    device = Device()
    device.is_present = True
    reopener = DeviceReopener(device.open, is_synchronous=True)
    reopener._open()  # an attempt that ended between two polls
    reopener.close()
    reopener.close()
    assert device.closed == 1

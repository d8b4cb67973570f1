"""The flow on a link: as much as it carries, and never much more than that under way."""

from __future__ import annotations

import pytest

from service.node.frame_sender import WINDOW_MAX_BYTES, WINDOW_MIN_BYTES, WINDOW_S, SendWindow


class LinkOf:
    """A link of so many bytes a second and such a delay, and a sender that always has more."""

    def __init__(self, rate: float, delay_s: float, message: int = 1400) -> None:
        self.flow = SendWindow()
        self.rate, self.delay_s, self.message = rate, delay_s, message
        self.now_s = 0.0
        self.busy_until_s = 0.0
        self.arrived = 0
        self.longest_s = 0.0
        self._answers: list[tuple[float, int]] = []
        self._number = 0

    def run(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            while self.flow.is_open:
                self.flow.add_sent_bytes(self.message)
                begin_s = max(self.now_s, self.busy_until_s)
                self.busy_until_s = begin_s + self.message / self.rate
                self.longest_s = max(self.longest_s, self.busy_until_s - self.now_s)
                self.arrived += self.message
                if self.flow.is_ping_due:
                    self._number += 1
                    self.flow.record_ping(self._number)
                    back_s = max(self.now_s, self.busy_until_s) + 2 * self.delay_s
                    self._answers.append((back_s, self._number))
            while self._answers and self._answers[0][0] <= self.now_s:
                self.flow.record_ping_answer(self._answers.pop(0)[1], self.now_s)
            self.now_s += 0.005


@pytest.mark.parametrize("rate", [60e3, 250e3, 1e6, 5e6])
@pytest.mark.parametrize("delay_s", [0.001, 0.02, 0.1])
def test_the_link_is_used_and_the_newest_frame_does_not_wait_long(
    rate: float, delay_s: float
) -> None:
    link = LinkOf(rate, delay_s)
    link.run(8.0)
    link.arrived, link.longest_s = 0, 0.0
    link.run(10.0)
    assert link.longest_s < max(2.0 * WINDOW_S, 1.5 * WINDOW_MIN_BYTES / rate)
    assert link.arrived > 0.6 * rate * 10.0


def test_nothing_more_goes_out_on_a_link_that_does_not_answer() -> None:
    flow = SendWindow()
    total = 0
    while flow.is_open:
        flow.add_sent_bytes(1000)
        total += 1000
    assert total < WINDOW_MIN_BYTES + 1000
    flow.record_ping_answer(7, 1.0)  # not a question that was asked
    assert not flow.is_open


def test_however_fast_the_link_the_window_has_an_end() -> None:
    flow = SendWindow()
    for number in range(100):
        flow.add_sent_bytes(10**8)
        flow.record_ping(number)
        flow.record_ping_answer(number, 0.01 * number)
    assert flow.window_bytes == WINDOW_MAX_BYTES
    assert flow.in_flight_bytes == 0

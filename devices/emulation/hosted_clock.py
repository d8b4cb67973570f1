"""Time as a driver has it on silicon, on a machine that also has to play the silicon.

On hardware a transfer ends when its last bit has passed. Here the same thread first computes what
the chips do, and is then woken a little late. What that costs is the emulation's, and no silicon's:
the driver's clock leaves it out, and goes on from the instant at which the transfer was over. Where
the driver or the wires wait next, that much less is waited, so the clock is CLOCK_MONOTONIC again;
it is never ahead of it. What the driver itself takes - its own code, its own wake-ups, a machine
that gives it no core meanwhile - passes on its clock as on any other.
"""

from __future__ import annotations

from devices.clock import Clock

BEHIND_MAX_NS = 20_000_000
"""So far the driver's clock may be behind: less than a batch. A machine that cannot play the wires
any faster makes its driver late, as it is."""


class HostedClock:
    """The driver's clock.

    Args:
        host: the machine's, of which this is never ahead.
    """

    def __init__(self, host: Clock) -> None:
        self._host = host
        self._host_now_ns = host.now_ns  # it is asked some fifty times a frame
        self._behind_ns = 0

    def now_ns(self) -> int:
        """Nanoseconds of the machine's clock, less what the emulation is behind."""
        return self._host_now_ns() - self._behind_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Wait as the driver does: being woken late is its own."""
        over_ns = self._host_now_ns() - t_ns
        if over_ns < 0:
            self._host.sleep_until_ns(t_ns)
            self._behind_ns = 0
        else:
            # It would have waited, at least a part of what the emulation was behind.
            self._behind_ns = min(self._behind_ns, over_ns)

    def resume_at(self, t_ns: int) -> None:
        """A transfer was over at `t_ns`, whatever it is now: the driver goes on from there."""
        self._behind_ns = min(max(0, self._host_now_ns() - t_ns), BEHIND_MAX_NS)


class WireClock:
    """The clock of what plays the silicon beneath that driver, in the driver's own thread.

    Args:
        driver: whose transfers are played.
        host: how the machine waits while bits pass.
    """

    def __init__(self, driver: HostedClock, host: Clock) -> None:
        self._driver = driver
        self._host = host

    def now_ns(self) -> int:
        """The driver's time: when a transfer begins."""
        return self._driver.now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """End a transfer, never before `t_ns`; the driver's clock says `t_ns` then.

        Args:
            t_ns: not before the instant at which the transfer began.
        """
        self._host.sleep_until_ns(t_ns)
        self._driver.resume_at(t_ns)

"""Clocks of a driver and its emulated wires that hide the emulation's computing time.

On hardware a transfer ends with its last bit. In an emulation the same thread first computes the
chips and is then woken a little late. The driver's clock excludes that time: it continues from the
instant at which the transfer ended on the wire. The next wait of the driver or the wires is shorter
by that lag, so that the clock returns to CLOCK_MONOTONIC, and is never ahead. Time of the
driver itself (code, wake-ups, missing CPU) passes as on any other clock.
"""

from __future__ import annotations

from devices.clock import Clock

LAG_MAX_NS = 20_000_000
"""Largest lag of the driver's clock: less than a batch. On a machine too slow for the emulation the
driver is really late."""


class DriverClock:
    """Clock of a driver on emulated wires.

    Args:
        host: clock of the machine, which this clock never overtakes.
    """

    def __init__(self, host: Clock) -> None:
        self._host = host
        self._host_now_ns = host.now_ns  # called some fifty times a frame
        self._lag_ns = 0

    def now_ns(self) -> int:
        """Return the machine's clock minus the emulation's lag."""
        return self._host_now_ns() - self._lag_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until `t_ns`; a late wake-up counts as the driver's time."""
        over_ns = self._host_now_ns() - t_ns
        if over_ns < 0:
            self._host.sleep_until_ns(t_ns)
            self._lag_ns = 0
        else:
            # The sleep would have absorbed at least a part of the lag.
            self._lag_ns = min(self._lag_ns, over_ns)

    def continue_from(self, t_ns: int) -> None:
        """Continue the driver's time from `t_ns`, the end of a transfer."""
        self._lag_ns = min(max(0, self._host_now_ns() - t_ns), LAG_MAX_NS)


class WireClock:
    """Clock of the emulated wires, in the driver's thread.

    Args:
        driver: clock of the driver.
        host: clock of the machine, for waiting while bits pass.
    """

    def __init__(self, driver: DriverClock, host: Clock) -> None:
        self._driver = driver
        self._host = host

    def now_ns(self) -> int:
        """Return the driver's time, the begin of a transfer."""
        return self._driver.now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Wait for the end of a transfer and set the driver's clock to it.

        Args:
            t_ns: end of the transfer, not before its begin.
        """
        self._host.sleep_until_ns(t_ns)
        self._driver.continue_from(t_ns)

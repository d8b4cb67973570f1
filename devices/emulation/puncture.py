"""A dome with a hole: its gas leaves under load, and air comes in again when it is let go.

A capillary, as a crack or a bad seam is one: the flow is proportional to the pressure difference
over the wall. A needle's hole takes some hundredths of a second to even it out, a pore minutes.
What has left is missing afterwards: unloaded, the dome reads less than its surroundings until air
has come back. One that has been open for long follows the weather, and no temperature.
"""

from __future__ import annotations

import math

from devices.emulation.faults import Fault


class Puncture:
    """What a hole makes of one dome's pressure; afterwards it is sealed with what it holds.

    Args:
        fault: while it is there the gas leaks.
        leak_s: in this time the pressure difference of an unsqueezed bubble falls to 1/e.
        around_kpa: pressure of the atmosphere.
    """

    def __init__(self, fault: Fault, leak_s: float, around_kpa: float) -> None:
        self._fault = fault
        self._leak_s = leak_s
        self._around_kpa = around_kpa
        self._left = 1.0  # amount of gas, relative to what was sealed in
        self._last_s = 0.0

    def leaked_kpa(self, sealed_kpa: float, t_s: float, t_ns: int) -> float:
        """Absolute pressure of the dome, of which `sealed_kpa` is that if it were whole.

        Between two calls the load is taken as constant: a chip samples every few milliseconds.

        Args:
            sealed_kpa: absolute.
            t_s: time of the scene, which never goes back.
            t_ns: the same instant of the clock.
        """
        if not self._fault.possible:
            return sealed_kpa
        if self._fault(t_ns):
            # At a constant volume the amount relaxes to that which gives the outer pressure, the
            # faster the more the bubble is squeezed.
            even = self._around_kpa / sealed_kpa
            kept = math.exp(-max(0.0, t_s - self._last_s) / (self._leak_s * even))
            self._left = even + (self._left - even) * kept
        self._last_s = t_s
        return self._left * sealed_kpa

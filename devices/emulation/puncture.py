"""Leak of a punctured dome: gas leaves under load, and air returns after unloading.

The leak is a capillary, like a crack or a bad seam: the flow is proportional to the pressure
difference over the wall. It equalises in some hundredths of a second through a needle's hole, in
minutes through a pore. The lost gas is missing afterwards: unloaded, the dome reads less than its
surroundings until air has returned. A dome open for long follows the weather, and no temperature.
"""

from __future__ import annotations

import math

from devices.emulation.fault_timing import FaultTiming


class Puncture:
    """Leak of one dome; after the fault it is sealed with the remaining gas.

    Args:
        fault: fault during which the gas leaks.
        leak_s: time constant of the pressure difference of an unloaded bubble.
        around_kpa: pressure of the atmosphere.
    """

    def __init__(self, fault: FaultTiming, leak_s: float, around_kpa: float) -> None:
        self._fault = fault
        self._leak_s = leak_s
        self._around_kpa = around_kpa
        self._remaining_gas = 1.0  # amount of gas, relative to what was sealed in
        self._last_s = 0.0

    def apply_leak(self, sealed_kpa: float, t_s: float, t_ns: int) -> float:
        """Compute the absolute pressure with the leak, and update the remaining gas.

        The load is taken as constant between two calls: a chip samples every few milliseconds.

        Args:
            sealed_kpa: absolute pressure without the leak.
            t_s: time of the scene, never decreasing.
            t_ns: the same instant of the clock.
        """
        if not self._fault.is_possible:
            return sealed_kpa
        if self._fault(t_ns):
            # At constant volume the amount relaxes to its value at outer pressure, faster under
            # load.
            even = self._around_kpa / sealed_kpa
            kept = math.exp(-max(0.0, t_s - self._last_s) / (self._leak_s * even))
            self._remaining_gas = even + (self._remaining_gas - even) * kept
        self._last_s = t_s
        return self._remaining_gas * sealed_kpa

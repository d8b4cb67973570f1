"""Reference force of a calibration rig: a load cell's amplifier, read through an MCP3208.

The scene gives the newtons per volt. The scale of the paper's sensor and amplifier is not known
(hardware.md 6), so there is no default.
"""

from __future__ import annotations

import math

from devices.chips.mcp3208 import COUNTS_MAX, COUNTS_PER_VREF, Mcp3208
from devices.errors import SpiError
from devices.scene.hardware_sections import ReferenceSection


class ReferenceForceSensor:
    """Reference force sensor. A failed reading is NaN and never an exception."""

    def __init__(self, adc: Mcp3208, scene: ReferenceSection) -> None:
        self.failed_readings = 0
        """Number of failed readings: no transfer, or no converter."""
        self.saturated_readings = 0
        """Number of readings at either end of the converter's range, which are no force."""
        self.warning = ""
        """Reason why the last reading gave no force; empty if it gave one."""
        self._adc = adc
        self._channel = scene.channel
        self._zero_v = scene.zero_v
        self._n_per_v = scene.n_per_v
        self._volts_per_count = scene.vref_v / COUNTS_PER_VREF

    def read_force_n(self) -> float:
        """Convert now and return the force in newtons.

        NaN if the reading failed or is at either rail: an open, shorted or overloaded amplifier
        must never give a plausible force.
        """
        try:
            counts = self._adc.read_counts(self._channel)
        except SpiError as error:
            self.failed_readings += 1
            self.warning = f"no reference force: {error}"
            return math.nan
        if counts in (0, COUNTS_MAX):
            self.saturated_readings += 1
            self.warning = "no reference force: the amplifier is off, unplugged or overloaded"
            return math.nan
        self.warning = ""
        return (counts * self._volts_per_count - self._zero_v) * self._n_per_v

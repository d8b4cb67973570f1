"""The calibration rig's reference force: a load cell's amplifier, read through an MCP3208.

The scene says what a volt means. The scale of the paper's sensor and amplifier is not known
(hardware.md 6), so there is no default for it.
"""

from __future__ import annotations

import math

from devices.chips.mcp3208 import COUNTS_MAX, COUNTS_PER_VREF, Mcp3208
from devices.errors import SpiError
from devices.scene.hardware import ReferenceScene


class ReferenceForce:
    """Force on the reference sensor. It never raises: a frame goes on without it."""

    def __init__(self, adc: Mcp3208, scene: ReferenceScene) -> None:
        self.failures = 0
        """Readings that failed: no transfer, or no converter."""
        self.on_rail = 0
        """Readings at either end of the converter, which say nothing about a force."""
        self.trouble = ""
        """Why the last reading gave no force, in words; empty if it gave one."""
        self._adc = adc
        self._channel = scene.channel
        self._zero_v = scene.zero_v
        self._n_per_v = scene.n_per_v
        self._volts_per_count = scene.vref_v / COUNTS_PER_VREF

    def read_n(self) -> float:
        """Convert now and return the force in newtons.

        NaN if the reading failed or is at either rail: an amplifier that is open, shorted or
        overloaded must never become a plausible force.
        """
        try:
            counts = self._adc.read_counts(self._channel)
        except SpiError as error:
            self.failures += 1
            self.trouble = f"no reference force: {error}"
            return math.nan
        if counts in (0, COUNTS_MAX):
            self.on_rail += 1
            self.trouble = "no reference force: the amplifier is off, unplugged or overloaded"
            return math.nan
        self.trouble = ""
        return (counts * self._volts_per_count - self._zero_v) * self._n_per_v

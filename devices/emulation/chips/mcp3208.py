"""Emulated MCP3208 at bit level, with its input amplifier.

Source: data sheet DS21298E section 5 (figures 5-1 and 5-2, table 5-2). The chip ignores byte
boundaries: it waits for the first high bit of a transfer, and counts clocks from there.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from devices.buses.spi import MAX_SPEED_HZ
from devices.chips.mcp3208 import COUNTS_MAX, COUNTS_PER_VREF
from devices.clock import Clock
from devices.scene.hardware_sections import ReferenceSection

InputVoltages = Callable[[int, int], float]
"""Function of input and instant in ns that returns the voltage, with noise and non-linearity."""

# Clocks after the start bit: SGL/DIFF, D2, D1, D0, then the clock that ends sampling.
_CONFIGURATION = 4
_SAMPLING = 5


class EmulatedMcp3208:
    """Emulated converter alone on its chip select: an `SpiDevice`.

    It samples at the end of the sampling clock; transfers take their time on the clock. A code
    begins half a count below its voltage.

    Args:
        input_voltages: voltages at the inputs.
        clock: virtual or real clock.
        vref_v: reference, in volts.
        max_speed_hz: SPI clock.
        floats_high: level of DOUT while the chip leaves it floating, up to the null bit. It is
            undefined on a real board; high by default, the worse case for a driver.
    """

    def __init__(
        self,
        input_voltages: InputVoltages,
        clock: Clock,
        *,
        vref_v: float = 3.3,
        max_speed_hz: int = MAX_SPEED_HZ,
        floats_high: bool = True,
    ) -> None:
        self._input_voltages = input_voltages
        self._clock = clock
        self._counts_per_v = COUNTS_PER_VREF / vref_v
        self._ns_per_bit = 1e9 / max_speed_hz
        self._floating = int(floats_high)

    def xfer2(self, data: list[int], /) -> list[int]:
        """Exchange bytes in one chip select; like spidev, it writes them into `data`."""
        begin_ns = self._clock.now_ns()
        sent = [byte >> shift & 1 for byte in data for shift in range(7, -1, -1)]
        received = self._compute_answer_bits(sent, begin_ns)
        for index in range(len(data)):
            byte = 0
            for bit in received[8 * index : 8 * index + 8]:
                byte = byte << 1 | bit
            data[index] = byte
        self._clock.sleep_until_ns(begin_ns + round(len(sent) * self._ns_per_bit))
        return data

    def close(self) -> None:
        """Close the device; it has no resources."""

    def _compute_answer_bits(self, sent: list[int], begin_ns: int) -> list[int]:
        start = sent.index(1) if 1 in sent else len(sent)
        sampling = start + _SAMPLING
        if sampling >= len(sent):
            return [self._floating] * len(sent)
        single_ended, *number = sent[start + 1 : start + 1 + _CONFIGURATION]
        d2, d1, d0 = number
        sample_ns = begin_ns + round((sampling + 1) * self._ns_per_bit)
        counts = self._convert(d2 << 2 | d1 << 1 | d0, bool(single_ended), sample_ns)
        msb_first = [counts >> bit & 1 for bit in range(11, -1, -1)]
        lsb_first = msb_first[-2::-1]  # B0 is not sent again
        answer = [self._floating] * (sampling + 1) + [0] + msb_first + lsb_first
        return (answer + [0] * len(sent))[: len(sent)]

    def _convert(self, number: int, single_ended: bool, t_ns: int) -> int:
        volts = self._input_voltages(number, t_ns)
        if not single_ended:  # the other input of the pair is the negative one (table 5-2)
            volts -= self._input_voltages(number ^ 1, t_ns)
        return min(max(math.floor(volts * self._counts_per_v + 0.5), 0), COUNTS_MAX)


def make_amplifier(
    force_n: Callable[[int], float],
    scene: ReferenceSection,
    *,
    noise_n: Callable[[], float] | None = None,
) -> InputVoltages:
    """Create the voltages of a load cell's amplifier at the scene's input; others are grounded.

    Args:
        force_n: force on the cell in newtons at an instant in ns.
        scene: section with the scale, which is inverted here.
        noise_n: draws the amplifier's noise of one reading, as a force in newtons; None: no noise.
    """

    def volts(channel: int, t_ns: int) -> float:
        if channel != scene.channel:
            return 0.0
        seen_n = force_n(t_ns) + (0.0 if noise_n is None else noise_n())
        return scene.zero_v + seen_n / scene.n_per_v

    return volts

"""Emulated Dynamixel MX servo behind a pseudo-terminal, for the real driver.

A thread answers any program that opens `port`: `devices.chips.dynamixel.driver`, or ROBOTIS's own
SDK. A pseudo-terminal has no wire, so the time on the wire and the return delay pass on the
injected clock: with a `SystemClock` an answer takes as long as a servo's, with a `VirtualClock` it
takes as long in virtual time, while the reader is blocked. The answers are in
`devices.emulation.chips.dynamixel_firmware`. Sources: hardware.md 5.1 and 5.2.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import tempfile
import termios
import threading
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Self

from devices.chips.dynamixel.protocol import Packet, PacketDecoder, compute_wire_time_ns
from devices.clock import Clock
from devices.emulation.chips.dynamixel_firmware import EMULATED_FIRMWARES
from devices.emulation.fault_timing import FaultTiming

# Baud rates as termios constants.
_SPEEDS = {
    9_600: termios.B9600,
    57_600: termios.B57600,
    115_200: termios.B115200,
    1_000_000: termios.B1000000,
    2_000_000: termios.B2000000,
    3_000_000: termios.B3000000,
    4_000_000: termios.B4000000,
}


class EmulatedServo:
    """Emulated servo alone on its line, powered from construction until `close`.

    `position` maps nanoseconds of the clock to signed counts; it is called on the servo's thread.
    `protocol` is 1 or 2. `return_delay_us` is in microseconds, 0 to 508 in steps of 2. During
    `unplugged` its USB adapter is absent; during `unpowered` it is silent, and then it restarts.

    Raises:
        UsageError: no MX servo runs at `baudrate`, or termios has no such rate (4.5 M).
    """

    def __init__(
        self,
        position: Callable[[int], int],
        clock: Clock,
        *,
        servo_id: int = 1,
        model: str = "MX-64",
        protocol: int = 2,
        baudrate: int = 1_000_000,
        return_delay_us: int = 500,
        status_return_level: int = 2,
        many_turns: bool = False,
        unplugged: FaultTiming | None = None,
        unpowered: FaultTiming | None = None,
    ) -> None:
        self._is_closed = False
        self._clock = clock
        self._baudrate = baudrate
        self._firmware = EMULATED_FIRMWARES[protocol](
            position,
            servo_id=servo_id,
            model=model,
            baudrate=baudrate,
            return_delay_us=return_delay_us,
            status_return_level=status_return_level,
            many_turns=many_turns,
        )
        self._speed = _SPEEDS[baudrate]
        self._unplugged = unplugged if unplugged is not None else FaultTiming()
        self._unpowered = unpowered if unpowered is not None else FaultTiming()
        self._seen_ns = self._plugged_ns = clock.now_ns()
        self._is_hung_up = False
        self._folder = tempfile.TemporaryDirectory(prefix="foottile-servo-")
        self._link = Path(self._folder.name, "ttyUSB0")
        self._plug_in()

    @property
    def port(self) -> str:
        """Path of the pseudo-terminal; it exists while the adapter is plugged in.

        Reading this property plugs a returned adapter in, so read it before each attempt to open.
        """
        now_ns = self._clock.now_ns()
        if self._is_hung_up and not self._unplugged(now_ns):
            self._plugged_ns = now_ns
            self._stop_thread()
            self._plug_in()
        return str(self._link)

    def _plug_in(self) -> None:
        # The slave's end stays open, or the line would hang up when a reader closes it.
        self._line, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self._link.symlink_to(os.ttyname(self._slave))
        # A servo does not wait for a reader; unread bytes are lost.
        os.set_blocking(self._line, False)
        self._wake, self._wake_writer = os.pipe()
        self._is_hung_up = False
        # A daemon only so that a forgotten `close` does not keep the interpreter from ending.
        self._thread = threading.Thread(target=self._serve, name="emulated servo", daemon=True)
        self._thread.start()

    def _hang_up(self) -> None:
        """Unplug the adapter: its open file fails, and its path vanishes."""
        self._link.unlink()
        self._is_hung_up = True
        for descriptor in (self._line, self._slave):
            os.close(descriptor)

    def _stop_thread(self) -> None:
        os.close(self._wake_writer)
        self._thread.join()
        os.close(self._wake)

    def close(self) -> None:
        """Power off: end the thread and hang up. Closing twice does no harm."""
        if self._is_closed:
            return
        self._is_closed = True
        self._stop_thread()
        if not self._is_hung_up:
            self._hang_up()
        self._folder.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # The servo's thread.

    def _serve(self) -> None:
        decoder = PacketDecoder(self._firmware.protocol)
        while True:
            ready, _, _ = select.select([self._line, self._wake], [], [])
            if self._wake in ready:
                return
            data = os.read(self._line, 4096)
            received_ns = self._clock.now_ns()
            since_ns, self._seen_ns = self._seen_ns, received_ns
            if self._unplugged.was_active_between(self._plugged_ns, received_ns):
                self._hang_up()
                return
            if self._unpowered.was_active_between(since_ns, received_ns):
                self._firmware.restart(received_ns)
            if self._unpowered(received_ns):
                continue
            # A pseudo-terminal has a baud rate, but no wire. At another rate a servo gets noise.
            if termios.tcgetattr(self._slave)[5] != self._speed:
                continue
            for packet in decoder.decode_bytes(data):
                if self._firmware.is_answered(packet):
                    self._answer(packet, received_ns)

    def _answer(self, packet: Packet, received_ns: int) -> None:
        request_end_ns = received_ns + compute_wire_time_ns(len(packet.raw_bytes), self._baudrate)
        begin_ns = request_end_ns + self._firmware.return_delay_ns
        self._clock.sleep_until_ns(begin_ns)
        reply = self._reply(packet, begin_ns)
        self._clock.sleep_until_ns(begin_ns + compute_wire_time_ns(len(reply), self._baudrate))
        with contextlib.suppress(BlockingIOError):
            os.write(self._line, reply)

    def _reply(self, packet: Packet, t_ns: int) -> bytes:
        return self._firmware.execute_packet(packet, t_ns)

"""A Dynamixel MX servo in Protocol 2.0 behind a pseudo-terminal, for the very code that reads one.

A thread answers at `port` whatever opens it: `devices.dynamixel`, or ROBOTIS's own SDK. A
pseudo-terminal has no wire, so the time on the wire and the return delay pass on the injected
clock: with a `SystemClock` an answer takes as long as a servo's, with a `VirtualClock` it takes as
long in virtual time, while whoever asked is blocked. Sources: hardware.md 5.1 and 5.2, e-manual
protocol2.md.

Where the sources are silent: gaps in the control table read as zero, and a read may begin and end
anywhere in it (so does an XM540, DynamixelSDK #175); there is one servo on the line, so it takes
the first slot after a broadcast; fast sync read is not known to it. Where it knows less than
silicon: it cannot be written to, and answers that like an undefined instruction.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import struct
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Self

from devices.clock import Clock
from devices.dynamixel import MODELS
from devices.dynamixel_packets import (
    ALERT,
    BROADCAST_ID,
    Instruction,
    Packet,
    PacketDecoder,
    instruction_packet,
    wire_time_ns,
)
from devices.errors import UsageError

FIRMWARE_VERSION = 42

# Control table (hardware.md 5). It ends behind Indirect Data 56 (SDK mx_64.model: 634 + 28).
_TABLE_SIZE = 662
_FIRMWARE, _ID, _BAUD, _RETURN_DELAY, _PROTOCOL = 6, 7, 8, 9, 13
_STATUS_RETURN_LEVEL, _HARDWARE_ERROR = 68, 70
_INPUT_VOLTAGE_ERROR = 1

# Baud codes, and the rate as the pseudo-terminal keeps it. Code 7, 4.5 M, has no termios constant.
_BAUDS = {
    9_600: (0, termios.B9600),
    57_600: (1, termios.B57600),
    115_200: (2, termios.B115200),
    1_000_000: (3, termios.B1000000),
    2_000_000: (4, termios.B2000000),
    3_000_000: (5, termios.B3000000),
    4_000_000: (6, termios.B4000000),
}

_INSTRUCTION_ERROR, _CRC_ERROR, _DATA_RANGE_ERROR, _DATA_LENGTH_ERROR = 2, 3, 4, 5

# Status return level from which an instruction is answered; every other needs level 2.
_ANSWERED_FROM: dict[int, int] = {
    Instruction.PING: 0,
    Instruction.READ: 1,
    Instruction.SYNC_READ: 1,
}


@dataclass(frozen=True)
class _Faults:
    silent: bool = False
    garbage: bytes = b""
    corrupt_crc: bool = False


class EmulatedServo:
    """One servo alone on its line, powered from construction until `close`.

    `position` maps nanoseconds of the clock to signed counts; it is called on the servo's thread.
    `return_delay_us` is in microseconds, 0 to 508 in steps of 2.

    Raises:
        UsageError: no MX servo runs at `baudrate`, or none (below 4.5 M) that termios can name.
    """

    def __init__(
        self,
        position: Callable[[int], int],
        clock: Clock,
        *,
        servo_id: int = 1,
        model: str = "MX-64",
        baudrate: int = 1_000_000,
        return_delay_us: int = 500,
        status_return_level: int = 2,
    ) -> None:
        if baudrate not in _BAUDS:
            raise UsageError(
                f"no emulated servo runs at {baudrate} baud",
                expected=", ".join(str(rate) for rate in _BAUDS),
            )
        self._position = position
        self._clock = clock
        self._model = MODELS[model]
        self._baudrate = baudrate
        self._table = bytearray(_TABLE_SIZE)
        struct.pack_into("<H", self._table, 0, self._model.number)
        self._table[_FIRMWARE] = FIRMWARE_VERSION
        self._table[_ID] = servo_id
        self._table[_BAUD], self._speed = _BAUDS[baudrate]
        self._table[_RETURN_DELAY] = return_delay_us // 2
        self._table[_PROTOCOL] = 2
        self._table[_STATUS_RETURN_LEVEL] = status_return_level
        self._faults = _Faults()
        self._resources = contextlib.ExitStack()
        self._power_up()

    def _power_up(self) -> None:
        # The slave's end stays open here too: else the line hangs up whenever a reader closes it.
        self._line, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        """What to open: the path of the pseudo-terminal."""
        # A servo does not wait for a listener; what nobody reads is lost.
        os.set_blocking(self._line, False)
        self._wake, wake_writer = os.pipe()
        # A daemon only so that a forgotten `close` does not keep the interpreter from ending.
        thread = threading.Thread(target=self._serve, name=f"servo at {self.port}", daemon=True)
        thread.start()
        # Unwound from the last to the first: closing the writer wakes and ends the thread.
        for descriptor in (self._line, self._slave, self._wake):
            self._resources.callback(os.close, descriptor)
        self._resources.callback(thread.join)
        self._resources.callback(os.close, wake_writer)

    def close(self) -> None:
        """Power off: end the thread and hang up. Closing twice does no harm."""
        self._resources.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Faults. Each lasts as long as its context and may be set from any thread.

    def silent(self) -> contextlib.AbstractContextManager[None]:
        """Answer nothing, as without power or with the plug pulled; but its state survives."""
        return self._with(silent=True)

    def garbage_before_reply(self, garbage: bytes) -> contextlib.AbstractContextManager[None]:
        """Send `garbage` before every answer. Unrealistic: it is always the same."""
        return self._with(garbage=garbage)

    def corrupt_crc(self) -> contextlib.AbstractContextManager[None]:
        """Invert the CRC of every answer. Unrealistic: a bad line hits any bit, now and then."""
        return self._with(corrupt_crc=True)

    @contextlib.contextmanager
    def alert(self) -> Iterator[None]:
        """Report an input voltage error. Unrealistic at its end: silicon keeps it until reboot."""
        self._table[_HARDWARE_ERROR] = _INPUT_VOLTAGE_ERROR
        try:
            yield
        finally:
            self._table[_HARDWARE_ERROR] = 0

    @contextlib.contextmanager
    def _with(self, **changes: Any) -> Iterator[None]:
        before = self._faults
        self._faults = replace(before, **changes)
        try:
            yield
        finally:
            self._faults = before

    # The servo's thread.

    def _serve(self) -> None:
        decoder = PacketDecoder()
        while True:
            ready, _, _ = select.select([self._line, self._wake], [], [])
            if self._wake in ready:
                return
            data = os.read(self._line, 4096)
            received_ns = self._clock.now_ns()
            # The one thing of a wire that a pseudo-terminal keeps is the rate it was opened with.
            # At any other than its own a servo hears noise.
            if termios.tcgetattr(self._slave)[5] != self._speed:
                continue
            for packet in decoder.feed(data):
                if self._is_answered(packet) and not self._faults.silent:
                    self._answer(packet, received_ns)

    def _is_answered(self, packet: Packet) -> bool:
        instruction = packet.instruction
        if self._table[_STATUS_RETURN_LEVEL] < _ANSWERED_FROM.get(instruction, 2):
            return False
        if packet.servo_id != BROADCAST_ID:
            # Another servo's answer, or the echo of an own one, is a status and no request.
            return packet.servo_id == self._table[_ID] and instruction != Instruction.STATUS
        called = instruction == Instruction.SYNC_READ and self._table[_ID] in packet.parameters[4:]
        return packet.crc_ok and (called or instruction == Instruction.PING)

    def _answer(self, packet: Packet, received_ns: int) -> None:
        request_end_ns = received_ns + wire_time_ns(packet.wire_bytes, self._baudrate)
        begin_ns = request_end_ns + self._table[_RETURN_DELAY] * 2000
        self._clock.sleep_until_ns(begin_ns)
        error, data = self._execute(packet, begin_ns)
        reply = self._faults.garbage + self._status(error, data)
        self._clock.sleep_until_ns(begin_ns + wire_time_ns(len(reply), self._baudrate))
        with contextlib.suppress(BlockingIOError):
            os.write(self._line, reply)

    def _status(self, error: int, data: bytes) -> bytes:
        alert = ALERT if self._table[_HARDWARE_ERROR] else 0
        parameters = bytes([alert | error]) + data
        status = instruction_packet(self._table[_ID], Instruction.STATUS, parameters)
        if self._faults.corrupt_crc:
            status = status[:-2] + bytes(byte ^ 0xFF for byte in status[-2:])
        return status

    def _execute(self, packet: Packet, t_ns: int) -> tuple[int, bytes]:
        """Error number and data of the answer to `packet`, executed at `t_ns`."""
        broadcast = packet.servo_id == BROADCAST_ID
        if not packet.crc_ok:
            return _CRC_ERROR, b""
        if packet.instruction == Instruction.PING:
            return 0, bytes(self._table[0:2]) + bytes([self._table[_FIRMWARE]])
        if packet.instruction == Instruction.READ:
            return self._read(packet.parameters, t_ns)
        if packet.instruction == Instruction.SYNC_READ and broadcast:
            return self._read(packet.parameters[:4], t_ns)
        return _INSTRUCTION_ERROR, b""

    def _read(self, parameters: bytes, t_ns: int) -> tuple[int, bytes]:
        if len(parameters) != 4:
            return _DATA_LENGTH_ERROR, b""
        address, length = struct.unpack("<HH", parameters)
        if length == 0:
            return _DATA_LENGTH_ERROR, b""
        if address + length > len(self._table):
            return _DATA_RANGE_ERROR, b""
        position = self._position(t_ns).to_bytes(4, "little", signed=True)
        struct.pack_into("4s", self._table, self._model.position_address, position)
        return 0, bytes(self._table[address : address + length])

"""Emulated Dynamixel MX servo behind a pseudo-terminal, for the real driver.

A thread answers any program that opens `port`: `devices.chips.dynamixel.driver`, or ROBOTIS's own
SDK. A pseudo-terminal has no wire, so the time on the wire and the return delay pass on the
injected clock: with a `SystemClock` an answer takes as long as a servo's, with a `VirtualClock` it
takes as long in virtual time, while the reader is blocked.

Sources: hardware.md 5, 5.1 and 5.2, e-manual protocol1.md, protocol2.md and the MX control tables.

Not documented, so assumed: gaps in the control table read as zero, and a read may begin and end
anywhere (as in an XM540, DynamixelSDK #175); as the only servo on the line it uses the first slot
after a broadcast; in 1.0 a read of no bytes, or beyond the table, is out of range. Not implemented:
writes and bulk reads, which are undefined instructions; fast sync read; in 1.0 the multi-turn
offset and the resolution divider.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import struct
import tempfile
import termios
import threading
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

from devices.chips.dynamixel.driver import TICK_PERIOD
from devices.chips.dynamixel.protocol import (
    ALERT,
    BROADCAST_ID,
    COUNTS_PER_TURN,
    FIRMWARES,
    ErrorFlag,
    Instruction,
    Packet,
    PacketDecoder,
    compute_wire_time_ns,
)
from devices.clock import Clock
from devices.emulation.fault_timing import FaultTiming
from devices.errors import UsageError

FIRMWARE_VERSION = 42
MULTI_TURN_LIMIT_COUNTS = 28_672
"""Limit of the count in Protocol 1.0, either way: seven turns (hardware.md 5)."""

_UPTIME_AT_FIRST_ANSWER_NS = 5_000_000_000
"""Uptime at the first answer."""

_ANSWERED_FROM: dict[int, int] = {Instruction.PING: 0, Instruction.READ: 1}
_INSTRUCTION_ERROR, _CRC_ERROR, _DATA_RANGE_ERROR, _DATA_LENGTH_ERROR = 2, 3, 4, 5
_HARDWARE_ERROR = 70  # address, of the 2.0 table only


@dataclass(frozen=True, slots=True)
class _Layout:
    """Addresses of the control table."""

    size: int
    firmware: int
    servo_id: int
    baud: int
    return_delay: int
    status_return_level: int
    protocol_type: int | None = None


class EmulatedFirmware(ABC):
    """Emulated firmware and control table of a servo.

    Args:
        position: maps nanoseconds of the clock to signed counts.
        servo_id: id of the servo.
        model: "MX-28" or "MX-64".
        baudrate: baud rate of the line.
        return_delay_us: 0 to 508 in steps of 2.
        status_return_level: 0 ping only, 1 ping and reads, 2 all.
        many_turns: True for multi-turn mode (extended position control).

    Raises:
        UsageError: no MX servo with this firmware runs at `baudrate`.
    """

    version: ClassVar[int]
    _layout: ClassVar[_Layout]
    _baud_codes: ClassVar[Mapping[int, int]]
    _modes: ClassVar[Mapping[bool, bytes]]
    """Operating mode: False: within one turn, the factory's; True: multi-turn."""
    _answered_from: ClassVar[Mapping[int, int]] = _ANSWERED_FROM
    """Status return level from which an instruction is answered; others need level 2."""

    def __init__(
        self,
        position: Callable[[int], int],
        *,
        servo_id: int,
        model: str,
        baudrate: int,
        return_delay_us: int,
        status_return_level: int,
        many_turns: bool = False,
    ) -> None:
        if baudrate not in self._baud_codes:
            raise UsageError(
                f"no emulated servo runs at {baudrate} baud in protocol {self.version}",
                expected=", ".join(str(rate) for rate in self._baud_codes),
            )
        firmware = FIRMWARES[self.version]
        self.protocol = firmware.protocol
        self.error_bits = ErrorFlag(0)
        """Error bits of every answer in 1.0; in 2.0 they are in the control table."""
        self._position = position
        self._register = firmware
        self._turn_offset_counts = 0
        self._powered_ns: int | None = None
        layout = self._layout
        self.control_table = bytearray(layout.size)
        struct.pack_into("<H", self.control_table, 0, firmware.model_numbers[model])
        self.control_table[layout.firmware] = FIRMWARE_VERSION
        self.control_table[layout.servo_id] = servo_id
        self.control_table[layout.baud] = self._baud_codes[baudrate]
        self.control_table[layout.return_delay] = return_delay_us // 2
        self.control_table[layout.status_return_level] = status_return_level
        if layout.protocol_type is not None:
            self.control_table[layout.protocol_type] = self.version
        mode = firmware.mode_register
        self.control_table[mode.address : mode.address + mode.size] = self._modes[many_turns]

    @property
    def return_delay_ns(self) -> int:
        """Delay between the end of a request and the beginning of its answer."""
        return self.control_table[self._layout.return_delay] * 2000

    def is_answered(self, packet: Packet) -> bool:
        """Return whether this servo answers `packet`."""
        level = self.control_table[self._layout.status_return_level]
        if level < self._answered_from.get(packet.instruction, 2):
            return False
        if packet.servo_id == BROADCAST_ID:
            called = packet.instruction == Instruction.PING or self._is_addressed_by(packet)
            return packet.is_intact and called
        return packet.servo_id == self._id and not self._is_an_answer(packet)

    def restart(self, t_ns: int) -> None:
        """Restart at `t_ns` after a loss of power: reset uptime and turns."""
        self._powered_ns = t_ns
        self._turn_offset_counts = self._position(t_ns) // COUNTS_PER_TURN * COUNTS_PER_TURN

    @abstractmethod
    def execute_packet(self, packet: Packet, t_ns: int) -> bytes:
        """Execute `packet` at `t_ns` and return the status packet."""

    def _is_addressed_by(self, packet: Packet) -> bool:
        """Return whether a broadcast addresses this servo."""
        return False

    def _is_an_answer(self, packet: Packet) -> bool:
        """Return whether a packet is an answer (another servo's, or an echo), not a request."""
        return False

    @property
    def _id(self) -> int:
        return self.control_table[self._layout.servo_id]

    def _counts(self, t_ns: int) -> int:
        return self._position(t_ns) - self._turn_offset_counts

    def _store_position(self, counts: int, t_ns: int) -> None:
        """Write the position and the Realtime Tick into the table."""
        if self._powered_ns is None:
            self._powered_ns = t_ns - _UPTIME_AT_FIRST_ANSWER_NS
        tick = (t_ns - self._powered_ns) // 1_000_000 % TICK_PERIOD
        struct.pack_into("<H", self.control_table, self._register.tick_register.address, tick)
        size, address = self._register.position_bytes, self._register.position_address
        self.control_table[address : address + size] = counts.to_bytes(size, "little", signed=True)


class _Firmware1(EmulatedFirmware):
    """Factory firmware, Protocol 1.0. Its table ends behind Goal Acceleration."""

    version = 1
    _modes: ClassVar = {False: b"\x00\x00\xff\x0f", True: b"\xff\x0f\xff\x0f"}
    _layout = _Layout(
        size=74, firmware=2, servo_id=3, baud=4, return_delay=5, status_return_level=16
    )
    _baud_codes: ClassVar = {
        9_600: 207,
        57_600: 34,
        115_200: 16,
        1_000_000: 1,
        2_000_000: 0,
        3_000_000: 252,
    }

    def execute_packet(self, packet: Packet, t_ns: int) -> bytes:
        error, data = self._execute(packet, t_ns)
        return self.protocol.encode_packet(self._id, self.error_bits | error, data)

    def _execute(self, packet: Packet, t_ns: int) -> tuple[ErrorFlag, bytes]:
        if not packet.is_intact:
            return ErrorFlag.CHECKSUM, b""
        if packet.instruction == Instruction.PING:
            return ErrorFlag(0), b""
        if packet.instruction != Instruction.READ:
            return ErrorFlag.INSTRUCTION, b""
        if len(packet.parameters) != 2:
            return ErrorFlag.RANGE, b""
        address, length = packet.parameters
        if length == 0 or address + length > len(self.control_table):
            return ErrorFlag.RANGE, b""
        counts = max(-MULTI_TURN_LIMIT_COUNTS, min(self._counts(t_ns), MULTI_TURN_LIMIT_COUNTS))
        if self.control_table[6:10] == bytes(4):  # both limits 0: wheel mode
            counts = self._position(t_ns) % COUNTS_PER_TURN
        self._store_position(counts, t_ns)
        return ErrorFlag(0), bytes(self.control_table[address : address + length])


class _Firmware2(EmulatedFirmware):
    """Firmware MX(2.0), Protocol 2.0. Its table ends behind Indirect Data 56 (SDK mx_64.model)."""

    version = 2
    _modes: ClassVar = {False: b"\x03", True: b"\x04"}
    _layout = _Layout(
        size=662,
        firmware=6,
        servo_id=7,
        baud=8,
        return_delay=9,
        status_return_level=68,
        protocol_type=13,
    )
    _baud_codes: ClassVar = {
        9_600: 0,
        57_600: 1,
        115_200: 2,
        1_000_000: 3,
        2_000_000: 4,
        3_000_000: 5,
        4_000_000: 6,  # code 7, 4.5 M, has no termios constant
    }
    _answered_from: ClassVar = {**_ANSWERED_FROM, Instruction.SYNC_READ: 1}

    def execute_packet(self, packet: Packet, t_ns: int) -> bytes:
        error, data = self._execute(packet, t_ns)
        alert = ALERT if self.control_table[_HARDWARE_ERROR] else 0
        return self.protocol.encode_packet(
            self._id, Instruction.STATUS, bytes([alert | error]) + data
        )

    def _is_addressed_by(self, packet: Packet) -> bool:
        return packet.instruction == Instruction.SYNC_READ and self._id in packet.parameters[4:]

    def _is_an_answer(self, packet: Packet) -> bool:
        return packet.instruction == Instruction.STATUS

    def _execute(self, packet: Packet, t_ns: int) -> tuple[int, bytes]:
        """Execute a packet; return error number and data."""
        broadcast = packet.servo_id == BROADCAST_ID
        if not packet.is_intact:
            return _CRC_ERROR, b""
        if packet.instruction == Instruction.PING:
            return 0, bytes(self.control_table[0:2]) + bytes(
                [self.control_table[self._layout.firmware]]
            )
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
        if address + length > len(self.control_table):
            return _DATA_RANGE_ERROR, b""
        self._store_position(self._counts(t_ns), t_ns)
        return 0, bytes(self.control_table[address : address + length])


EMULATED_FIRMWARES: dict[int, type[EmulatedFirmware]] = {1: _Firmware1, 2: _Firmware2}
"""Emulated firmwares by protocol version."""


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

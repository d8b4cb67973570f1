"""Dynamixel MX servos over Protocol 2.0, read only: who is there, and where its shaft stands.

Sources: e-manual of the MX series and hardware.md 5. A servo can neither be moved nor set up from
here, so that no mistake in a measurement can move a robot.
"""

from __future__ import annotations

import contextlib
import termios
from dataclasses import dataclass
from typing import Protocol

import serial

from devices.clock import Clock
from devices.dynamixel_packets import (
    ALERT,
    ERRORS,
    Instruction,
    Packet,
    PacketDecoder,
    instruction_packet,
    read_packet,
    wire_time_ns,
)
from devices.errors import (
    ServoError,
    ServoPacketError,
    ServoSetupError,
    ServoStatusError,
    ServoTimeoutError,
)

# Far more than a status (16 bytes at most here): it bounds a line that never stops chattering.
_MAX_BYTES_PER_ANSWER = 256

_PORT_ERRORS = (OSError, termios.error)


@dataclass(frozen=True, slots=True)
class ServoModel:
    """What differs, or might, between models with "MX(2.0)" firmware (hardware.md 5)."""

    number: int
    """The model number at address 0, which a ping returns."""
    counts_per_turn: int = 4096
    position_address: int = 132
    position_length: int = 4
    """Bytes of the present position, little-endian and signed."""


MODELS = {"MX-28": ServoModel(number=30), "MX-64": ServoModel(number=311)}


class SerialPort(Protocol):
    """What a servo needs of a serial port: `serial.Serial`, or a test's."""

    def write(self, data: bytes, /) -> int | None:
        """Send `data`."""

    def read(self, size: int, /) -> bytes:
        """Up to `size` bytes; fewer, or none, once the port's time-out is over."""

    def reset_input_buffer(self) -> None:
        """Discard what has come in so far."""

    def close(self) -> None:
        """Release the port."""


@dataclass(frozen=True, slots=True)
class PositionReading:
    """A position and when it was true: at `t_mono_ns`, give or take `half_width_ns`."""

    counts: int
    """Signed; 4096 to the turn, beyond one turn in multi-turn mode."""
    t_mono_ns: int
    """Nanoseconds of the clock, midway between end of request and first byte of the answer."""
    half_width_ns: int
    done_ns: int
    """When the answer was complete, nanoseconds of the clock."""
    alert: bool = False
    """The servo reports a hardware error; the position is valid all the same."""


class Dynamixel:
    """One servo. Not thread-safe: one thread owns a port.

    `timeout_s`, in seconds, should be the port's own: it is the longest that one read of it waits.
    """

    def __init__(
        self,
        port: SerialPort,
        clock: Clock,
        *,
        servo_id: int,
        baudrate: int,
        timeout_s: float,
        model: str = "MX-64",
    ) -> None:
        self._port = port
        self._clock = clock
        self._id = servo_id
        self._baudrate = baudrate
        self._timeout_ns = round(timeout_s * 1e9)
        self._where = f"servo {servo_id} at {baudrate} baud"
        self._position_length = MODELS[model].position_length
        self._ping = instruction_packet(servo_id, Instruction.PING)
        self._read = read_packet(servo_id, MODELS[model].position_address, self._position_length)

    def ping(self) -> int:
        """The servo's model number (`ServoModel.number`).

        Raises:
            ServoTimeoutError: no answer within the time-out.
            ServoPacketError: an answer with a wrong CRC, id or length, or nothing but noise.
            ServoStatusError: the servo answered with an error number.
            ServoSetupError: the port itself failed, as when its plug is pulled.
        """
        status, _, _ = self._exchange(self._ping, n_data=3)
        return int.from_bytes(status.parameters[1:3], "little")

    def read_position(self) -> PositionReading:
        """The present position. Raises what `ping` raises.

        The servo samples it somewhere between the last bit of the request and the first of the
        answer (hardware.md 5.2); a slow adapter delays the answer and so widens the interval.
        """
        status, start_ns, done_ns = self._exchange(self._read, n_data=self._position_length)
        earliest_ns = start_ns + wire_time_ns(len(self._read), self._baudrate)
        latest_ns = done_ns - wire_time_ns(status.wire_bytes, self._baudrate)
        return PositionReading(
            counts=int.from_bytes(status.parameters[1:], "little", signed=True),
            t_mono_ns=(earliest_ns + latest_ns) // 2,
            half_width_ns=max(0, latest_ns - earliest_ns + 1) // 2,
            done_ns=done_ns,
            alert=bool(status.parameters[0] & ALERT),
        )

    def close(self) -> None:
        """Close the port."""
        self._port.close()

    def _exchange(self, request: bytes, n_data: int) -> tuple[Packet, int, int]:
        """The status with `n_data` bytes, and the instants of asking and of its last byte, ns."""
        try:
            # Packets carry no number: a late answer to an older request would pass for this one's.
            self._port.reset_input_buffer()
            start_ns = self._clock.now_ns()
            self._port.write(request)
            status, done_ns = self._await_status(start_ns + self._timeout_ns)
        except ServoError:  # a ServoTimeoutError is an OSError too
            raise
        except _PORT_ERRORS as error:
            raise ServoSetupError(
                f"the serial port failed ({error})",
                where=self._where,
                remedy="Check the adapter's plug, and that nothing else uses the port",
            ) from error
        self._check(status, n_data)
        return status, start_ns, done_ns

    def _await_status(self, deadline_ns: int) -> tuple[Packet, int]:
        decoder = PacketDecoder()
        n_bytes = 0
        while n_bytes < _MAX_BYTES_PER_ANSWER:
            data = self._port.read(min(decoder.missing, _MAX_BYTES_PER_ANSWER - n_bytes))
            done_ns = self._clock.now_ns()
            if not data or done_ns > deadline_ns:
                # The port has waited in real time; a virtual clock has yet to.
                self._clock.sleep_until_ns(deadline_ns)
                raise self._timed_out(n_bytes)
            n_bytes += len(data)
            for packet in reversed(decoder.feed(data)):
                # Whole packets that are no status are our own, echoed by a one-wire adapter.
                if packet.instruction == Instruction.STATUS or not packet.crc_ok:
                    return packet, done_ns
        raise self._packet_error(f"{n_bytes} bytes came and no status packet among them")

    def _timed_out(self, n_bytes: int) -> ServoTimeoutError:
        noise = f" ({n_bytes} bytes came, but no whole packet)" if n_bytes else ""
        return ServoTimeoutError(
            f"no answer within {self._timeout_ns / 1e6:g} ms{noise}",
            where=self._where,
            remedy="Check the servo's power, its id, its baud rate, that its firmware speaks "
            "Protocol 2.0, and that the adapter's latency timer is 1 ms",
        )

    def _packet_error(self, what: str, expected: str = "") -> ServoPacketError:
        remedy = "Check the cable and its termination, and that no two servos share an id"
        return ServoPacketError(what, where=self._where, expected=expected, remedy=remedy)

    def _check(self, status: Packet, n_data: int) -> None:
        if not status.crc_ok:
            raise self._packet_error("the CRC of the answer is wrong")
        if status.servo_id != self._id:
            raise self._packet_error(f"servo {status.servo_id} answered", f"servo {self._id}")
        if status.parameters and (number := status.parameters[0] & ~ALERT):
            meaning = ERRORS[number] if number < len(ERRORS) else "unknown"
            raise ServoStatusError(
                f"the servo answered with error {number}, {meaning}", where=self._where
            )
        if len(status.parameters) != 1 + n_data:
            raise self._packet_error(f"{len(status.parameters)} parameters", str(1 + n_data))


def open_servo(
    port: str,
    *,
    baudrate: int,
    clock: Clock,
    servo_id: int = 1,
    timeout_s: float = 0.1,
    model: str = "MX-64",
) -> Dynamixel:
    """Open the servo at `port`: /dev/ttyUSB0 and the like, or an emulated servo's `port`.

    The default `timeout_s`, in seconds, is ample for the slowest case: 9600 baud (30 ms), the
    longest return delay (0.5 ms) and an FTDI's default latency timer (16 ms).

    Raises:
        ServoSetupError: there is no such port, it may not be used, or somebody else uses it.
    """
    try:
        line = serial.Serial(
            port, baudrate, timeout=timeout_s, write_timeout=timeout_s, exclusive=True
        )
    except (*_PORT_ERRORS, ValueError) as error:
        raise ServoSetupError(
            f"the serial port cannot be opened ({error})",
            where=port,
            remedy="Check that the device exists, that this user is in the group dialout, that no "
            "other program has it open, and the baud rate",
        ) from error
    # Saves up to 15 ms per read on FTDI adapters (hardware.md 5.2); others refuse, and need not.
    with contextlib.suppress(ValueError):
        line.set_low_latency_mode(True)
    return Dynamixel(
        line, clock, servo_id=servo_id, baudrate=baudrate, timeout_s=timeout_s, model=model
    )

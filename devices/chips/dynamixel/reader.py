"""Dynamixel MX servos over Protocol 1.0 or 2.0, read only: identity and position.

Sources: e-manual of the MX series and hardware.md 5. A servo can neither be moved nor set up from
here, so that no mistake in a measurement can move a robot.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass

from devices.buses.serial_line import PORT_ERRORS, SerialPort, latency_remark, open_line
from devices.chips.dynamixel.models import FIRMWARES, known_model
from devices.chips.dynamixel.packets import PacketDecoder, Status, wire_time_ns
from devices.clock import Clock
from devices.errors import (
    ServoError,
    ServoPacketError,
    ServoSetupError,
    ServoStatusError,
    ServoTimeoutError,
)

# Far more than a status (15 bytes at most here): it bounds a line that never stops chattering.
_MAX_BYTES_PER_ANSWER = 256


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


@dataclass(frozen=True, slots=True)
class ServoIdentity:
    """What a servo says of itself."""

    model_number: int
    firmware_version: int


@dataclass(frozen=True, slots=True)
class _Answer:
    status: Status
    asked_ns: int
    done_ns: int
    """Its last byte."""


class Dynamixel:
    """One servo. Not thread-safe: one thread owns a port.

    `timeout_s`, in seconds, should be the port's own: it is the longest that one read of it waits.
    `protocol` is 1 or 2.
    """

    def __init__(
        self,
        port: SerialPort,
        clock: Clock,
        *,
        servo_id: int,
        baudrate: int,
        timeout_s: float,
        protocol: int = 2,
    ) -> None:
        self.remarks: tuple[str, ...] = ()
        """What is wrong with this servo, but does not stop the frames."""
        self._port = port
        self._clock = clock
        self._id = servo_id
        self._baudrate = baudrate
        self._timeout_ns = round(timeout_s * 1e9)
        self._where = f"servo {servo_id} at {baudrate} baud, protocol {protocol}"
        self._firmware = FIRMWARES[protocol]
        self._protocol = self._firmware.protocol
        self._identity_request = self._protocol.identity_request(servo_id)
        self._position_request = self._protocol.read_request(
            servo_id, self._firmware.position_address, self._firmware.asked_bytes
        )

    def identify(self) -> ServoIdentity:
        """Model number and firmware version.

        Raises:
            ServoTimeoutError: no answer within the time-out.
            ServoPacketError: an answer that is damaged, another servo's, or of another length, or
                nothing but noise.
            ServoStatusError: the servo refused.
            ServoSetupError: the port itself failed, as when its plug is pulled.
        """
        data = self._exchange(self._identity_request, n_data=3).status.data
        return ServoIdentity(int.from_bytes(data[:2], "little"), data[2])

    def check_model(self, model: str) -> None:
        """Ask the servo whether it is the `model` with the firmware that the scene says.

        Raises:
            ServoSetupError: it is another; the text names the keys to set.
            ServoError: as for `identify`.
        """
        number = self.identify().model_number
        expected = self._firmware.model_numbers[model]
        if number == expected:
            return
        what, remedy = f"a servo with model number {number} answers", "Plug in the one of the scene"
        if known := known_model(number):
            name, protocol = known
            what = f"an {name} with firmware for Protocol {protocol}.0 answers"
            if protocol == self._protocol.version:
                remedy = f'Set model = "{name}" in [servo]'
            else:
                remedy = (
                    f"Its firmware speaks Protocol {protocol}.0 once address 13, Protocol Type, "
                    f"says so: set that to {protocol}, and in [servo] protocol = {protocol}"
                )
        raise ServoSetupError(
            what,
            where=self._where,
            expected=f"an {model} with firmware for Protocol {self._protocol.version}.0, "
            f"model number {expected}",
            remedy=remedy,
        )

    def read_position(self) -> PositionReading:
        """The present position. Raises what `identify` raises.

        The servo samples it somewhere between the last bit of the request and the first of the
        answer (hardware.md 5.2); a slow adapter delays the answer and so widens the interval.
        """
        answer = self._exchange(self._position_request, n_data=self._firmware.asked_bytes)
        earliest_ns = answer.asked_ns + wire_time_ns(len(self._position_request), self._baudrate)
        latest_ns = answer.done_ns - wire_time_ns(len(answer.status.packet.wire), self._baudrate)
        position = answer.status.data[: self._firmware.position_bytes]
        return PositionReading(
            counts=int.from_bytes(position, "little", signed=True),
            t_mono_ns=(earliest_ns + latest_ns) // 2,
            half_width_ns=max(0, latest_ns - earliest_ns + 1) // 2,
            done_ns=answer.done_ns,
            alert=answer.status.alert,
        )

    def close(self) -> None:
        """Close the port."""
        self._port.close()

    def _exchange(self, request: bytes, n_data: int) -> _Answer:
        """The answer to `request` with `n_data` bytes."""
        try:
            # Packets carry no number: a late answer to an older request would pass for this one's.
            self._port.reset_input_buffer()
            asked_ns = self._clock.now_ns()
            sent = self._port.write(request)
            if sent is not None and sent != len(request):
                raise OSError(errno.EIO, f"{sent} of {len(request)} bytes sent")
            status, done_ns = self._await_status(request, asked_ns + self._timeout_ns)
        except ServoError:  # a ServoTimeoutError is an OSError too
            raise
        except PORT_ERRORS as error:
            raise ServoSetupError(
                f"the serial port failed ({error})",
                where=self._where,
                remedy="Check the adapter's plug, and that nothing else uses the port",
            ) from error
        self._check(status, n_data)
        return _Answer(status, asked_ns, done_ns)

    def _await_status(self, request: bytes, deadline_ns: int) -> tuple[Status, int]:
        decoder = PacketDecoder(self._protocol)
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
                # A one-wire adapter hands back what it was given.
                echo = packet.wire == request
                if not echo and (status := self._protocol.status(packet)) is not None:
                    return status, done_ns
        raise self._packet_error(f"{n_bytes} bytes came and no status packet among them")

    def _timed_out(self, n_bytes: int) -> ServoTimeoutError:
        noise = f" ({n_bytes} bytes came, but no whole status packet)" if n_bytes else ""
        return ServoTimeoutError(
            f"no answer within {self._timeout_ns / 1e6:g} ms{noise}",
            where=self._where,
            remedy="Check the servo's power, its id, its baud rate, that its firmware speaks "
            f"Protocol {self._protocol.version}.0, and that the adapter's latency timer is 1 ms",
        )

    def _packet_error(self, what: str, expected: str = "") -> ServoPacketError:
        remedy = "Check the cable and its termination, and that no two servos share an id"
        return ServoPacketError(what, where=self._where, expected=expected, remedy=remedy)

    def _check(self, status: Status, n_data: int) -> None:
        if not status.packet.intact:
            raise self._packet_error("the answer is damaged: its checksum does not fit")
        if (other := status.packet.servo_id) != self._id:
            raise self._packet_error(f"servo {other} answered", f"servo {self._id}")
        if status.refusal:
            raise ServoStatusError(f"the servo refused: {status.refusal}", where=self._where)
        if len(status.data) != n_data:
            raise self._packet_error(f"an answer of {len(status.data)} bytes", f"{n_data} bytes")


def open_servo(
    port: str,
    *,
    baudrate: int,
    clock: Clock,
    servo_id: int = 1,
    timeout_s: float = 0.1,
    model: str = "MX-64",
    protocol: int = 2,
) -> Dynamixel:
    """Open the servo at `port`: /dev/ttyUSB0 and the like, or an emulated servo's `port`.

    It is asked who it is. One that does not answer is opened all the same, for it may yet come to
    life: that, and a slow adapter, are among the `remarks` of what is returned.

    The default `timeout_s`, in seconds, is ample for the slowest case: 9600 baud (30 ms), the
    longest return delay (0.5 ms) and an FTDI's default latency timer (16 ms).

    Raises:
        ServoSetupError: there is no such port, it may not be used, or another program uses it; or
            another model or firmware answers than `model` and `protocol`.
    """
    line = open_line(port, baudrate, timeout_s)
    servo = Dynamixel(
        line,
        clock,
        servo_id=servo_id,
        baudrate=baudrate,
        timeout_s=timeout_s,
        protocol=protocol,
    )
    slow, silent = latency_remark(port), None
    try:
        servo.check_model(model)
    except ServoSetupError:
        servo.close()
        raise
    except ServoError as error:
        silent = str(error)
    servo.remarks = tuple(remark for remark in (slow, silent) if remark is not None)
    return servo

"""Read-only driver of Dynamixel MX servos over Protocol 1.0 or 2.0: identity and position.

Sources: e-manual of the MX series and hardware.md 5. The driver has no write commands, so that no
mistake in a measurement can move a robot.

A restart is detected by the Realtime Tick, milliseconds since power-up. It counts 0 to 32767 and
wraps (e-manual, Realtime Tick), so after a silence of half a minute it is ambiguous. Firmware of
Protocol 1.0 before version 40 has no such register; then any silence may have been a restart.
"""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Callable
from dataclasses import dataclass

from devices.buses.serial_line import PORT_ERRORS, SEND_TIMEOUT_ERROR, SerialPort
from devices.chips.dynamixel.protocol import (
    FIRMWARES,
    CountRange,
    PacketDecoder,
    Register,
    ServoAnswer,
    compute_wire_time_ns,
    find_model,
)
from devices.clock import Clock
from devices.errors import (
    ServoError,
    ServoLostError,
    ServoPacketError,
    ServoSetupError,
    ServoStatusError,
    ServoTimeoutError,
)


@dataclass(frozen=True, slots=True)
class PositionReading:
    """Position with its sample instant, `t_mono_ns` within `half_width_ns`."""

    counts: int
    """Signed; 4096 to the turn, beyond one turn in multi-turn mode."""
    t_mono_ns: int
    """Sample instant: midway between end of request and first byte of the answer."""
    half_width_ns: int
    answered_ns: int
    """Instant at which the answer was complete."""
    has_alert: bool = False
    """True if the servo reports a hardware error; the position is still valid."""
    has_restarted: bool = False
    """True if the servo restarted, or may have, since the previous reading."""
    count_range: CountRange = CountRange.MANY_TURNS
    is_turn_known: bool = True
    """True if the number of whole turns is known; set by `TurnUnwrapper`."""


TICK_PERIOD = 32_768
_TOLERANCE_MS, _TOLERANCE_PART = 20.0, 0.05  # of the servo's own clock: not documented
_SILENCE_MAX_MS = 25_000.0  # beyond it the tolerance and the wrap leave no answer


class RestartDetector:
    """Detector that compares each tick with the previous one."""

    def __init__(self) -> None:
        self._tick: int | None = None
        self._t_ns = 0
        self._is_supported = True

    def detect_restart(self, tick_ms: int | None, t_ns: int, *, silent_ns: int) -> bool:
        """Update with a tick; return whether the servo restarted, or may have, since the last one.

        Args:
            tick_ms: present tick; None: the servo has no such register.
            t_ns: instant of the clock.
            silent_ns: time without an answer before `t_ns`; 0: the servo answered all along.
        """
        before, elapsed_ms = self._tick, (t_ns - self._t_ns) * 1e-6
        self._tick, self._t_ns = tick_ms, t_ns
        if before is None and tick_ms is not None:
            return False
        if tick_ms is None or (tick_ms == before and elapsed_ms > _TOLERANCE_MS):
            self._is_supported = False  # a constant tick: firmware without this register
        if not self._is_supported or tick_ms is None or before is None:
            return silent_ns > 0
        if elapsed_ms > _SILENCE_MAX_MS:
            return True
        off_ms = (tick_ms - before - elapsed_ms + TICK_PERIOD / 2) % TICK_PERIOD - TICK_PERIOD / 2
        if abs(off_ms) > _TOLERANCE_MS + _TOLERANCE_PART * elapsed_ms:
            return True
        # The tick fits, but a servo powered up during the silence could match by chance.
        return silent_ns > 0 and tick_ms <= silent_ns * 1e-6 + _TOLERANCE_MS


# Far more than a status (15 bytes at most here): a bound for a line with endless noise.
_MAX_BYTES_PER_ANSWER = 256

REOPEN_INTERVAL_NS = 1_000_000_000
"""Interval of attempts to reopen a missing port."""
_UNANSWERED_MAX = 3
UPTIME_INTERVAL_NS = 1_000_000_000
"""Interval of uptime checks while the servo answers."""


@dataclass(frozen=True, slots=True)
class ServoIdentity:
    """Model number and firmware version of a servo."""

    model_number: int
    firmware_version: int


@dataclass(frozen=True, slots=True)
class _TimedAnswer:
    status: ServoAnswer
    requested_ns: int
    answered_ns: int
    """Instant of the last byte."""


class DynamixelServo:
    """Driver of one servo. Not thread-safe: one thread owns a port.

    Args:
        port: serial port; None: `ensure_open` has to open it first.
        clock: virtual or real clock.
        servo_id: id of the servo.
        baudrate: baud rate of the line.
        timeout_s: timeout of an answer, in seconds; should be the port's own read timeout.
        protocol: 1 or 2.
        model: "MX-28" or "MX-64", to check after reopening the port.
        reopen: reopens the port after a failure, at most once a second, and enables the detection
            of restarts; None: neither.
    """

    def __init__(
        self,
        port: SerialPort | None,
        clock: Clock,
        *,
        servo_id: int,
        baudrate: int,
        timeout_s: float,
        protocol: int = 2,
        model: str = "",
        reopen: Callable[[], SerialPort] | None = None,
    ) -> None:
        self.opening_warnings: tuple[str, ...] = ()
        """Warnings from opening the servo, which do not stop acquisition."""
        self._port = port
        self._model = model
        self._reopen = reopen
        self._reopen_due_ns = clock.now_ns()
        self._lost: ServoSetupError | None = None
        self._restart_detector = RestartDetector() if reopen is not None else None
        self._uptime_ns = clock.now_ns()
        self._count_range: CountRange | None = None
        self._answered_ns = clock.now_ns()
        self._was_silent = True
        self._restarted = False
        self._unanswered = 0
        self._clock = clock
        self._id = servo_id
        self._baudrate = baudrate
        self._timeout_ns = round(timeout_s * 1e9)
        self._where = f"servo {servo_id} at {baudrate} baud, protocol {protocol}"
        self._firmware = FIRMWARES[protocol]
        self._protocol = self._firmware.protocol
        self._identity_request = self._protocol.encode_identity_request(servo_id)
        self._position_request = self._protocol.encode_read_request(
            servo_id, self._firmware.position_address, self._firmware.position_read_bytes
        )

    def read_identity(self) -> ServoIdentity:
        """Read model number and firmware version.

        Raises:
            ServoTimeoutError: no answer within the timeout.
            ServoPacketError: the answer is damaged, another servo's, of another length, or noise.
            ServoStatusError: the servo refused.
            ServoSetupError: the port itself failed, as when its plug is pulled.
        """
        data = self._send_request(self._identity_request, n_data=3).status.data
        return ServoIdentity(int.from_bytes(data[:2], "little"), data[2])

    def check_model(self, model: str) -> None:
        """Check that the servo is a `model` with firmware for the scene's protocol.

        Raises:
            ServoSetupError: another model or firmware; the text names the keys to set.
            ServoError: as for `identify`.
        """
        number = self.read_identity().model_number
        expected = self._firmware.model_numbers[model]
        if number == expected:
            return
        what, remedy = f"a servo with model number {number} answers", "Plug in the one of the scene"
        if known := find_model(number):
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
        """Read the present position; reopen the port and check the uptime if due.

        The servo samples between the last bit of the request and the first of the answer
        (hardware.md 5.2); a slow adapter delays the answer and so widens the interval.

        Raises:
            ServoError: as for `identify`.
        """
        try:
            self._ensure_port()
            answer = self._send_request(
                self._position_request, n_data=self._firmware.position_read_bytes
            )
            if self._was_silent or answer.answered_ns - self._uptime_ns >= UPTIME_INTERVAL_NS:
                self.check_uptime()
        except ServoError:
            self._was_silent = True
            raise
        self._was_silent, self._answered_ns = False, answer.answered_ns
        earliest_ns = answer.requested_ns + compute_wire_time_ns(
            len(self._position_request), self._baudrate
        )
        latest_ns = answer.answered_ns - compute_wire_time_ns(
            len(answer.status.packet.raw_bytes), self._baudrate
        )
        position = answer.status.data[: self._firmware.position_bytes]
        restarted, self._restarted = self._restarted, False
        return PositionReading(
            counts=int.from_bytes(position, "little", signed=True),
            t_mono_ns=(earliest_ns + latest_ns) // 2,
            half_width_ns=max(0, latest_ns - earliest_ns + 1) // 2,
            answered_ns=answer.answered_ns,
            has_alert=answer.status.has_alert,
            has_restarted=restarted,
            count_range=self._count_range or CountRange.MANY_TURNS,
        )

    def check_uptime(self) -> None:
        """Read the uptime and detect a restart; after a silence read the operating mode, too.

        Raises:
            ServoError: as for `identify`.
        """
        if self._restart_detector is None:
            return
        if self._was_silent or self._count_range is None:
            mode = self._read_register(self._firmware.mode_register)
            self._count_range = None if mode is None else self._firmware.get_count_range(mode)
        data = self._read_register(self._firmware.tick_register)
        now_ns = self._clock.now_ns()
        tick = None if data is None else int.from_bytes(data[:2], "little")
        silent_ns = now_ns - self._answered_ns if self._was_silent else 0
        self._restarted |= self._restart_detector.detect_restart(tick, now_ns, silent_ns=silent_ns)
        self._uptime_ns = self._answered_ns = now_ns
        self._was_silent = False

    def _read_register(self, register: Register) -> bytes | None:
        """Read a register; None if the servo refuses, or has never answered there."""
        if self._unanswered >= _UNANSWERED_MAX:
            return None
        request = self._protocol.encode_read_request(self._id, register.address, register.size)
        try:
            data = self._send_request(request, n_data=register.size).status.data
        except ServoStatusError:
            return None
        except ServoTimeoutError:
            self._unanswered += 1
            raise
        self._unanswered = 0
        return data

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()

    def _ensure_port(self) -> None:
        """Reopen a missing port, at most once a second, and check the servo's model.

        Raises:
            ServoSetupError: the port is still missing, or another servo answers.
        """
        if self._port is not None or self._reopen is None:
            return
        now_ns = self._clock.now_ns()
        if now_ns < self._reopen_due_ns and self._lost is not None:
            raise self._lost
        self._reopen_due_ns = now_ns + REOPEN_INTERVAL_NS
        try:
            self._port = self._reopen()
            with contextlib.suppress(ServoTimeoutError, ServoPacketError, ServoStatusError):
                self.check_model(self._model)
        except ServoSetupError as error:
            self._close_failed_port()
            self._lost = error
            raise
        self._lost = None

    def _close_failed_port(self) -> None:
        """Close a failed port, so that its device number becomes free."""
        if self._port is not None and self._reopen is not None:
            with contextlib.suppress(*PORT_ERRORS):
                self._port.close()
            self._port = None

    def _send_request(self, request: bytes, n_data: int) -> _TimedAnswer:
        """Send `request` and return its answer with `n_data` bytes."""
        port = self._port
        if port is None:
            raise self._make_port_error("it is not open")
        try:
            # Packets have no number: discard a late answer to an older request.
            port.reset_input_buffer()
            requested_ns = self._clock.now_ns()
            sent = port.write(request)
            if sent is not None and sent != len(request):
                raise OSError(errno.EIO, f"{sent} of {len(request)} bytes sent")
            status, done_ns = self._read_answer(port, request, requested_ns + self._timeout_ns)
        except ServoError:  # a ServoTimeoutError is an OSError too
            raise
        except SEND_TIMEOUT_ERROR as error:
            raise self._make_timeout_error(0) from error
        except PORT_ERRORS as error:
            self._close_failed_port()
            self._lost = self._make_port_error(str(error))
            raise self._lost from error
        self._check_answer(status, n_data)
        return _TimedAnswer(status, requested_ns, done_ns)

    def _make_port_error(self, why: str) -> ServoLostError:
        return ServoLostError(
            f"the serial port failed ({why})",
            where=self._where,
            remedy="Check the adapter's plug, and that nothing else uses the port",
        )

    def _read_answer(
        self, port: SerialPort, request: bytes, deadline_ns: int
    ) -> tuple[ServoAnswer, int]:
        decoder = PacketDecoder(self._protocol)
        n_bytes = 0
        while n_bytes < _MAX_BYTES_PER_ANSWER:
            data = port.read(min(decoder.min_missing_bytes, _MAX_BYTES_PER_ANSWER - n_bytes))
            done_ns = self._clock.now_ns()
            if not data or done_ns > deadline_ns:
                # The port has waited in real time; advance a virtual clock, too.
                self._clock.sleep_until_ns(deadline_ns)
                raise self._make_timeout_error(n_bytes)
            n_bytes += len(data)
            for packet in reversed(decoder.decode_bytes(data)):
                # A one-wire adapter echoes the request.
                echo = packet.raw_bytes == request
                if not echo and (status := self._protocol.decode_answer(packet)) is not None:
                    return status, done_ns
        raise self._make_packet_error(f"{n_bytes} bytes came and no status packet among them")

    def _make_timeout_error(self, n_bytes: int) -> ServoTimeoutError:
        noise = f" ({n_bytes} bytes came, but no whole status packet)" if n_bytes else ""
        return ServoTimeoutError(
            f"no answer within {self._timeout_ns / 1e6:g} ms{noise}",
            where=self._where,
            remedy="Check the servo's power, its id, its baud rate, that its firmware speaks "
            f"Protocol {self._protocol.version}.0, and that the adapter's latency timer is 1 ms",
        )

    def _make_packet_error(self, what: str, expected: str = "") -> ServoPacketError:
        remedy = "Check the cable and its termination, and that no two servos share an id"
        return ServoPacketError(what, where=self._where, expected=expected, remedy=remedy)

    def _check_answer(self, status: ServoAnswer, n_data: int) -> None:
        if not status.packet.is_intact:
            raise self._make_packet_error("the answer is damaged: its checksum does not fit")
        if (other := status.packet.servo_id) != self._id:
            raise self._make_packet_error(f"servo {other} answered", f"servo {self._id}")
        if status.refusal_reason:
            raise ServoStatusError(f"the servo refused: {status.refusal_reason}", where=self._where)
        if len(status.data) != n_data:
            raise self._make_packet_error(
                f"an answer of {len(status.data)} bytes", f"{n_data} bytes"
            )

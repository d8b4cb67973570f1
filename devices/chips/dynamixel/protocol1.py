"""Dynamixel Protocol 1.0, as pure functions of bytes.

Requests and answers have the same form, and a one-wire adapter echoes requests. An answer may equal
its request: the answer to a ping, with the voltage bit set, is a ping. So the driver sends no
request whose answer would have the same length: no ping, no read of two bytes.

Sources: e-manual protocol1.md, hardware.md 5.1.
"""

from __future__ import annotations

from enum import IntFlag

from devices.chips.dynamixel.protocol import (
    BROADCAST_ID,
    DynamixelProtocol,
    Instruction,
    Packet,
    ServoAnswer,
)

# Instruction or error to checksum. Longer than the whole control table of an MX, which ends at
# address 73, is noise: the header is short, and a wrong length would cause a timeout.
_MIN_LENGTH, _MAX_LENGTH = 2, 2 + 74


class ErrorFlag(IntFlag):
    """Bits of an answer's error byte (e-manual protocol1.md, "Error")."""

    VOLTAGE = 0x01
    ANGLE = 0x02
    """The goal position, not the present one, is outside the limits."""
    OVERHEAT = 0x04
    RANGE = 0x08
    CHECKSUM = 0x10
    OVERLOAD = 0x20
    INSTRUCTION = 0x40
    UNDEFINED = 0x80

    ALERT = VOLTAGE | ANGLE | OVERHEAT | OVERLOAD
    """Mask of the bits that report a bad state; the request succeeded and the data are valid."""


_REFUSALS = {
    ErrorFlag.RANGE: "range",
    ErrorFlag.CHECKSUM: "checksum of the request",
    ErrorFlag.INSTRUCTION: "undefined instruction",
    ErrorFlag.UNDEFINED: "unknown",
}


def compute_checksum(data: bytes) -> int:
    """Compute the inverted sum of `data`, all bytes from the id on (e-manual protocol1.md)."""
    return ~sum(data) & 0xFF


class _Protocol1(DynamixelProtocol):
    """`FF FF ID LEN INST parameters SUM`; an answer has its error byte in the place of INST."""

    version = 1
    max_servo_id = 253
    header = b"\xff\xff"
    preamble_bytes = 4
    shortest_bytes = 4 + _MIN_LENGTH

    def compute_packet_size(self, preamble: bytes) -> int:
        servo_id, length = preamble[2], preamble[3]
        # An id of FF is the header's second byte, after an FF of noise.
        plausible = servo_id <= BROADCAST_ID and _MIN_LENGTH <= length <= _MAX_LENGTH
        return self.preamble_bytes + length if plausible else 0

    def encode_packet(self, servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
        body = bytes([servo_id, len(parameters) + _MIN_LENGTH, instruction]) + parameters
        return self.header + body + bytes([compute_checksum(body)])

    def decode_packet(self, raw_bytes: bytes) -> Packet:
        intact = compute_checksum(raw_bytes[2:-1]) == raw_bytes[-1]
        return Packet(raw_bytes[2], raw_bytes[4], raw_bytes[5:-1], intact, raw_bytes)

    def encode_read_request(self, servo_id: int, address: int, length: int) -> bytes:
        return self.encode_packet(servo_id, Instruction.READ, bytes([address, length]))

    def encode_identity_request(self, servo_id: int) -> bytes:
        return self.encode_read_request(servo_id, 0, 3)

    def decode_answer(self, packet: Packet) -> ServoAnswer | None:
        error = ErrorFlag(packet.instruction)
        refusal = ", ".join(meaning for bit, meaning in _REFUSALS.items() if error & bit)
        return ServoAnswer(packet, packet.parameters, bool(error & ErrorFlag.ALERT), refusal)


PROTOCOL_1 = _Protocol1()

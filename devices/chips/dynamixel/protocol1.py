"""Dynamixel Protocol 1.0, as pure functions of bytes.

Requests and answers have the same form, and a one-wire adapter echoes requests. An answer may equal
its request: the answer to a ping, with the voltage bit set, is a ping. So the driver sends no
request whose answer would have the same length: no ping, no read of two bytes.

Sources: e-manual protocol1.md, hardware.md 5.1.
"""

from __future__ import annotations

from enum import IntFlag

from devices.chips.dynamixel.packets import (
    BROADCAST_ID,
    DynamixelProtocol,
    Instruction,
    Packet,
    Status,
)

# Instruction or error to checksum. Longer than the whole control table of an MX, which ends at
# address 73, is noise: the header is short, and a wrong length would cause a timeout.
_MIN_LENGTH, _MAX_LENGTH = 2, 2 + 74


class Error(IntFlag):
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
    Error.RANGE: "range",
    Error.CHECKSUM: "checksum of the request",
    Error.INSTRUCTION: "undefined instruction",
    Error.UNDEFINED: "unknown",
}


def checksum(data: bytes) -> int:
    """Compute the inverted sum of `data`, all bytes from the id on (e-manual protocol1.md)."""
    return ~sum(data) & 0xFF


class _Protocol1(DynamixelProtocol):
    """`FF FF ID LEN INST parameters SUM`; an answer has its error byte in the place of INST."""

    version = 1
    highest_id = 253
    header = b"\xff\xff"
    preamble_bytes = 4
    shortest_bytes = 4 + _MIN_LENGTH

    def size(self, preamble: bytes) -> int:
        servo_id, length = preamble[2], preamble[3]
        # An id of FF is the header's second byte, after an FF of noise.
        plausible = servo_id <= BROADCAST_ID and _MIN_LENGTH <= length <= _MAX_LENGTH
        return self.preamble_bytes + length if plausible else 0

    def pack(self, servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
        body = bytes([servo_id, len(parameters) + _MIN_LENGTH, instruction]) + parameters
        return self.header + body + bytes([checksum(body)])

    def unpack(self, wire: bytes) -> Packet:
        intact = checksum(wire[2:-1]) == wire[-1]
        return Packet(wire[2], wire[4], wire[5:-1], intact, wire)

    def read_request(self, servo_id: int, address: int, length: int) -> bytes:
        return self.pack(servo_id, Instruction.READ, bytes([address, length]))

    def identity_request(self, servo_id: int) -> bytes:
        return self.read_request(servo_id, 0, 3)

    def status(self, packet: Packet) -> Status | None:
        error = Error(packet.instruction)
        refusal = ", ".join(meaning for bit, meaning in _REFUSALS.items() if error & bit)
        return Status(packet, packet.parameters, bool(error & Error.ALERT), refusal)


PROTOCOL_1 = _Protocol1()

"""Dynamixel Protocol 2.0, as pure functions of bytes.

Sources: e-manual protocol2.md and crc.md, hardware.md 5.1.
"""

from __future__ import annotations

import struct

from devices.chips.dynamixel.protocol import DynamixelProtocol, Instruction, Packet, ServoAnswer

ALERT = 0x80
"""Bit of the error byte: a hardware error (register at address 70); the answer is valid."""
ERRORS = (
    "none",
    "result fail",
    "undefined instruction",
    "CRC of the request",
    "data range",
    "data length",
    "data limit",
    "access",
)
"""Meaning of the number in the error byte's other bits (e-manual protocol2.md, "Error")."""

_CRC = 2
_MIN_LENGTH, _MAX_LENGTH = 1 + _CRC, 1024  # instruction to CRC; more is noise (the SDK's limit)
_PATTERN, _STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
        table.append(crc & 0xFFFF)
    return table


_CRC_TABLE = _crc_table()


def compute_crc16(data: bytes) -> int:
    """Compute the CRC-16 of Protocol 2.0: polynomial 0x8005, initially 0 (e-manual crc.md)."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


class _Protocol2(DynamixelProtocol):
    """`FF FF FD 00 ID LEN LEN INST parameters CRC CRC`; a status begins with its error."""

    version = 2
    max_servo_id = 252
    header = b"\xff\xff\xfd\x00"
    preamble_bytes = 7
    shortest_bytes = 7 + _MIN_LENGTH

    def compute_packet_size(self, preamble: bytes) -> int:
        length = int.from_bytes(preamble[5:7], "little")
        return self.preamble_bytes + length if _MIN_LENGTH <= length <= _MAX_LENGTH else 0

    def encode_packet(self, servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
        # Length and CRC are of the stuffed bytes.
        body = (bytes([instruction]) + parameters).replace(_PATTERN, _STUFFED)
        packet = self.header + struct.pack("<BH", servo_id, len(body) + _CRC) + body
        return packet + struct.pack("<H", compute_crc16(packet))

    def decode_packet(self, raw_bytes: bytes) -> Packet:
        intact = compute_crc16(raw_bytes[:-_CRC]) == int.from_bytes(raw_bytes[-_CRC:], "little")
        body = raw_bytes[self.preamble_bytes : -_CRC].replace(_STUFFED, _PATTERN)
        return Packet(raw_bytes[4], body[0], body[1:], intact, raw_bytes)

    def encode_read_request(self, servo_id: int, address: int, length: int) -> bytes:
        return self.encode_packet(servo_id, Instruction.READ, struct.pack("<HH", address, length))

    def encode_identity_request(self, servo_id: int) -> bytes:
        return self.encode_packet(servo_id, Instruction.PING)

    def decode_answer(self, packet: Packet) -> ServoAnswer | None:
        if packet.is_intact and packet.instruction != Instruction.STATUS:
            return None
        error = packet.parameters[0] if packet.parameters else 0
        refusal, number = "", error & ~ALERT
        if number:
            meaning = ERRORS[number] if number < len(ERRORS) else "unknown"
            refusal = f"error {number}, {meaning}"
        return ServoAnswer(packet, packet.parameters[1:], bool(error & ALERT), refusal)


PROTOCOL_2 = _Protocol2()

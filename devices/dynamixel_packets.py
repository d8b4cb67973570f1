"""Packets of Dynamixel Protocol 2.0, as pure functions of bytes.

Sources: e-manual protocol2.md and crc.md, hardware.md 5.1 and 5.2.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

BROADCAST_ID = 0xFE
ALERT = 0x80
"""Bit of the error byte: the hardware complains (address 70 says of what); the answer is valid."""
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

_HEADER = b"\xff\xff\xfd\x00"
_PREAMBLE = 7  # header, id and the two bytes of the length
_CRC = 2
_MIN_LENGTH, _MAX_LENGTH = 1 + _CRC, 1024  # instruction to CRC; more is noise (the SDK's limit)
_PATTERN, _STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"


class Instruction(IntEnum):
    """Instructions of Protocol 2.0 that FootTile speaks (hardware.md 5.1)."""

    PING = 0x01
    READ = 0x02
    STATUS = 0x55
    SYNC_READ = 0x82


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
        table.append(crc & 0xFFFF)
    return table


_CRC_TABLE = _crc_table()


def crc16(data: bytes) -> int:
    """CRC-16 of Protocol 2.0: polynomial 0x8005, initially 0, not reflected (e-manual crc.md)."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


def instruction_packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """One packet, ready for the wire: stuffed first, then length and CRC over what was stuffed."""
    body = (bytes([instruction]) + parameters).replace(_PATTERN, _STUFFED)
    packet = _HEADER + struct.pack("<BH", servo_id, len(body) + _CRC) + body
    return packet + struct.pack("<H", crc16(packet))


def read_packet(servo_id: int, address: int, length: int) -> bytes:
    """The instruction to read `length` bytes of the control table from `address` on."""
    return instruction_packet(servo_id, Instruction.READ, struct.pack("<HH", address, length))


def wire_time_ns(n_bytes: int, baudrate: int) -> int:
    """Nanoseconds that `n_bytes` take at 8N1: ten bits per byte (hardware.md 5.2)."""
    return n_bytes * 10 * 1_000_000_000 // baudrate


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet off the wire, unstuffed. A status packet's first parameter is its error byte."""

    servo_id: int
    instruction: int
    parameters: bytes
    crc_ok: bool
    wire_bytes: int
    """Its length on the wire, stuffing included."""


class PacketDecoder:
    """Finds packets in a stream of bytes, however it is cut and whatever lies between them."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def missing(self) -> int:
        """The fewest bytes that must still come. Who asks for no more never waits in vain."""
        return self._size() - len(self._buffer)

    def feed(self, data: bytes) -> list[Packet]:
        """Add `data`; return the packets it completes, in order, whether their CRC fits or not."""
        self._buffer += data
        packets = []
        while self._seek_packet():
            packets.append(self._take_packet())
        return packets

    def _size(self) -> int:
        known = len(self._buffer) >= _PREAMBLE
        return _PREAMBLE + (int.from_bytes(self._buffer[5:7], "little") if known else _MIN_LENGTH)

    def _seek_packet(self) -> bool:
        buffer = self._buffer
        while True:
            start = buffer.find(_HEADER)
            if start < 0:  # but the last bytes may be the beginning of one
                kept = (n for n in (3, 2, 1) if buffer.endswith(_HEADER[:n]))
                start = len(buffer) - next(kept, 0)
            del buffer[:start]
            if _MIN_LENGTH <= self._size() - _PREAMBLE <= _MAX_LENGTH:
                return self.missing <= 0
            del buffer[: len(_HEADER)]

    def _take_packet(self) -> Packet:
        size = self._size()
        frame = bytes(self._buffer[:size])
        crc_ok = crc16(frame[:-_CRC]) == int.from_bytes(frame[-_CRC:], "little")
        # Stuffing keeps headers out of packets. So if the CRC is wrong, the header may have been
        # noise that swallowed a true one: go on right behind it.
        del self._buffer[: size if crc_ok else len(_HEADER)]
        body = frame[_PREAMBLE:-_CRC].replace(_STUFFED, _PATTERN)
        return Packet(frame[4], body[0], body[1:], crc_ok, size)

"""What both Dynamixel protocols share: packets, the search for them, and what a protocol is.

Sources: e-manual protocol1.md and protocol2.md, hardware.md 5.1 and 5.2.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum

BROADCAST_ID = 0xFE


class Instruction(IntEnum):
    """Instructions that FootTile speaks (hardware.md 5.1); the last two exist in 2.0 only."""

    PING = 0x01
    READ = 0x02
    STATUS = 0x55
    SYNC_READ = 0x82


def wire_time_ns(n_bytes: int, baudrate: int) -> int:
    """Nanoseconds that `n_bytes` take at 8N1: ten bits per byte (hardware.md 5.2)."""
    return n_bytes * 10 * 1_000_000_000 // baudrate


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet off the wire, unstuffed.

    Whether it asks or answers is written in it in 2.0 only. In 1.0 the byte of the `instruction` is
    the error byte of an answer, and the listener has to know which of the two it is.
    """

    servo_id: int
    instruction: int
    parameters: bytes
    intact: bool
    """Its CRC or checksum fits."""
    wire: bytes
    """As it came, stuffing and checksum included."""


@dataclass(frozen=True, slots=True)
class Status:
    """What a servo answered."""

    packet: Packet
    data: bytes
    alert: bool
    """The hardware complains; the data are valid all the same."""
    refusal: str
    """Why the servo did not do what it was asked; empty if it did."""


class DynamixelProtocol(ABC):
    """One version of the protocol: pure functions of bytes, no state."""

    version: int
    highest_id: int
    header: bytes
    preamble_bytes: int
    """From the header to the end of the length."""
    shortest_bytes: int
    """A packet without parameters."""

    @abstractmethod
    def size(self, preamble: bytes) -> int:
        """Bytes of the packet with this beginning; 0 if it is noise."""

    @abstractmethod
    def pack(self, servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
        """One packet, ready for the wire."""

    @abstractmethod
    def unpack(self, wire: bytes) -> Packet:
        """The packet in bytes whose length is the one they say."""

    @abstractmethod
    def read_request(self, servo_id: int, address: int, length: int) -> bytes:
        """The packet that asks for `length` bytes of the control table from `address` on."""

    @abstractmethod
    def identity_request(self, servo_id: int) -> bytes:
        """The packet that asks for model number (2 bytes, little-endian) and firmware version."""

    @abstractmethod
    def status(self, packet: Packet) -> Status | None:
        """`packet` as an answer; None if it cannot be one."""


class PacketDecoder:
    """Finds packets in a stream of bytes, however it is cut and whatever lies between them."""

    def __init__(self, protocol: DynamixelProtocol) -> None:
        self._protocol = protocol
        self._buffer = bytearray()

    @property
    def missing(self) -> int:
        """The fewest bytes that must still come: asking for no more never waits in vain."""
        known = len(self._buffer) >= self._protocol.preamble_bytes
        size = self._size() if known else self._protocol.shortest_bytes
        return size - len(self._buffer)

    def feed(self, data: bytes) -> list[Packet]:
        """Add `data`; return the packets it completes, in order, whether they are intact or not."""
        self._buffer += data
        packets = []
        while self._seek_packet():
            packets.append(self._take_packet())
        return packets

    def _size(self) -> int:
        return self._protocol.size(bytes(self._buffer[: self._protocol.preamble_bytes]))

    def _seek_packet(self) -> bool:
        """Drop what comes before a packet's beginning; is all of the packet there?"""
        buffer, header = self._buffer, self._protocol.header
        while True:
            start = buffer.find(header)
            if start < 0:  # but the last bytes may be the beginning of one
                kept = (n for n in range(len(header) - 1, 0, -1) if buffer.endswith(header[:n]))
                start = len(buffer) - next(kept, 0)
            del buffer[:start]
            if len(buffer) < self._protocol.preamble_bytes:
                return False
            if size := self._size():
                return len(buffer) >= size
            del buffer[0]

    def _take_packet(self) -> Packet:
        packet = self._protocol.unpack(bytes(self._buffer[: self._size()]))
        # A header that noise made may have swallowed a true one: go on right behind it.
        del self._buffer[: len(packet.wire) if packet.intact else 1]
        return packet

"""Common part of both Dynamixel protocols: packets, their decoder, and the protocol's interface.

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


def compute_wire_time_ns(n_bytes: int, baudrate: int) -> int:
    """Compute the time of `n_bytes` on the wire at 8N1: ten bits per byte (hardware.md 5.2)."""
    return n_bytes * 10 * 1_000_000_000 // baudrate


@dataclass(frozen=True, slots=True)
class Packet:
    """Packet from the wire, unstuffed.

    Only 2.0 marks requests and answers. In 1.0 the byte of the `instruction` is the error byte of
    an answer, and the receiver has to know the direction.
    """

    servo_id: int
    instruction: int
    parameters: bytes
    is_intact: bool
    """True if the CRC or checksum is correct."""
    raw_bytes: bytes
    """Raw bytes, with stuffing and checksum."""


@dataclass(frozen=True, slots=True)
class ServoAnswer:
    """Decoded answer of a servo."""

    packet: Packet
    data: bytes
    has_alert: bool
    """True if the servo reports a hardware error; the data are still valid."""
    refusal_reason: str
    """Reason why the servo refused the request; empty if it did not."""


class DynamixelProtocol(ABC):
    """Version of the protocol: pure functions of bytes, no state."""

    version: int
    max_servo_id: int
    header: bytes
    preamble_bytes: int
    """Length from the header to the end of the length field."""
    shortest_bytes: int
    """Length of a packet without parameters."""

    @abstractmethod
    def compute_packet_size(self, preamble: bytes) -> int:
        """Return the length of the packet with this preamble; 0 if it is noise."""

    @abstractmethod
    def encode_packet(self, servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
        """Encode a packet for the wire."""

    @abstractmethod
    def decode_packet(self, raw_bytes: bytes) -> Packet:
        """Decode a packet from bytes of its full length."""

    @abstractmethod
    def encode_read_request(self, servo_id: int, address: int, length: int) -> bytes:
        """Encode a request for `length` bytes of the control table from `address` on."""

    @abstractmethod
    def encode_identity_request(self, servo_id: int) -> bytes:
        """Encode a request for model number (2 bytes, little-endian) and firmware version."""

    @abstractmethod
    def decode_answer(self, packet: Packet) -> ServoAnswer | None:
        """Decode `packet` as an answer; None if it is not an answer."""


class PacketDecoder:
    """Decoder of packets in a byte stream with any split and with noise between packets."""

    def __init__(self, protocol: DynamixelProtocol) -> None:
        self._protocol = protocol
        self._buffer = bytearray()

    @property
    def min_missing_bytes(self) -> int:
        """Fewest bytes until a packet can be complete: a read of so many never waits in vain."""
        known = len(self._buffer) >= self._protocol.preamble_bytes
        size = self._size() if known else self._protocol.shortest_bytes
        return size - len(self._buffer)

    def decode_bytes(self, data: bytes) -> list[Packet]:
        """Add `data`; return the completed packets, in order, intact or not."""
        self._buffer += data
        packets = []
        while self._seek_packet():
            packets.append(self._pop_packet())
        return packets

    def _size(self) -> int:
        return self._protocol.compute_packet_size(
            bytes(self._buffer[: self._protocol.preamble_bytes])
        )

    def _seek_packet(self) -> bool:
        """Drop bytes before a header; return whether a complete packet is in the buffer."""
        buffer, header = self._buffer, self._protocol.header
        while True:
            start = buffer.find(header)
            if start < 0:  # the last bytes may be the beginning of a header
                kept = (n for n in range(len(header) - 1, 0, -1) if buffer.endswith(header[:n]))
                start = len(buffer) - next(kept, 0)
            del buffer[:start]
            if len(buffer) < self._protocol.preamble_bytes:
                return False
            if size := self._size():
                return len(buffer) >= size
            del buffer[0]

    def _pop_packet(self) -> Packet:
        packet = self._protocol.decode_packet(bytes(self._buffer[: self._size()]))
        # A false header in noise may have swallowed a true one: go on right behind it.
        del self._buffer[: len(packet.raw_bytes) if packet.is_intact else 1]
        return packet

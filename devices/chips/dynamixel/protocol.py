"""Dynamixel Protocols 1.0 and 2.0: packets and their decoder, and the firmwares that use them.

Sources: e-manual protocol1.md, protocol2.md and crc.md, hardware.md 5.1 and 5.2.

Requests and answers have the same form, and a one-wire adapter echoes requests. In 1.0 an answer
may equal its request: the answer to a ping, with the voltage bit set, is a ping. So in 1.0 the
driver sends no request whose answer would have the same length: no ping, no read of two bytes.

The factory's firmware uses Protocol 1.0. "MX(2.0)" firmware uses 2.0 and has another control table
and another model number (e-manual mx-28.md, mx-64.md and their `-2` pages).
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum, IntFlag

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


# Instruction or error to checksum. Longer than the whole control table of an MX, which ends at
# address 73, is noise: the header is short, and a wrong length would cause a timeout.
_MIN_LENGTH_1, _MAX_LENGTH_1 = 2, 2 + 74


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
    shortest_bytes = 4 + _MIN_LENGTH_1

    def compute_packet_size(self, preamble: bytes) -> int:
        servo_id, length = preamble[2], preamble[3]
        # An id of FF is the header's second byte, after an FF of noise.
        plausible = servo_id <= BROADCAST_ID and _MIN_LENGTH_1 <= length <= _MAX_LENGTH_1
        return self.preamble_bytes + length if plausible else 0

    def encode_packet(self, servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
        body = bytes([servo_id, len(parameters) + _MIN_LENGTH_1, instruction]) + parameters
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


ALERT = 0x80
"""Bit of the error byte: a hardware error (register at address 70); the answer is valid."""
_ERRORS_2 = (
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
_MIN_LENGTH_2, _MAX_LENGTH_2 = 1 + _CRC, 1024  # instruction to CRC; more is noise (the SDK's limit)
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
    shortest_bytes = 7 + _MIN_LENGTH_2

    def compute_packet_size(self, preamble: bytes) -> int:
        length = int.from_bytes(preamble[5:7], "little")
        return self.preamble_bytes + length if _MIN_LENGTH_2 <= length <= _MAX_LENGTH_2 else 0

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
            meaning = _ERRORS_2[number] if number < len(_ERRORS_2) else "unknown"
            refusal = f"error {number}, {meaning}"
        return ServoAnswer(packet, packet.parameters[1:], bool(error & ALERT), refusal)


PROTOCOL_2 = _Protocol2()


COUNTS_PER_TURN = 4096
"""Encoder counts per turn of every MX servo (hardware.md 5)."""


class CountRange(Enum):
    """Range of a servo's count, which depends on its operating mode."""

    ONE_TURN = "one turn"
    """Position control (joint mode): the joint stays within the turn that the encoder measures."""
    MANY_TURNS = "many turns"
    """Multi-turn: the count continues beyond a turn, from its value at power-up."""
    WRAPPED = "wrapped"
    """Wheel mode of Protocol 1.0: the joint turns on, the count stays within a turn."""


@dataclass(frozen=True, slots=True)
class Register:
    """Register of a control table."""

    address: int
    size: int
    """Bytes to read: never two in 1.0, see the module's docstring."""


@dataclass(frozen=True, slots=True)
class Firmware:
    """Protocol and registers of a firmware."""

    protocol: DynamixelProtocol
    model_numbers: Mapping[str, int]
    """Model number at address 0, by the model's name."""
    position_address: int
    position_bytes: int
    """Bytes of the present position: little-endian, signed, beyond one turn in multi-turn mode."""
    position_read_bytes: int
    """Bytes to read from there: in 1.0 one more, see the module's docstring."""
    tick_register: Register
    """Realtime Tick: its first two bytes are milliseconds since power-up."""
    mode_register: Register
    """Operating Mode; in 1.0 the limits of the angle, CW and CCW, which decide the mode."""

    def get_count_range(self, mode_bytes: bytes) -> CountRange:
        """Return the range of the count for the content of `mode_register`."""
        if self.protocol.version == 2:
            return (
                CountRange.ONE_TURN if mode_bytes[0] == _POSITION_CONTROL else CountRange.MANY_TURNS
            )
        limits = mode_bytes[:4]
        if limits == _WHEEL:
            return CountRange.WRAPPED
        return CountRange.MANY_TURNS if limits == _MULTI_TURN else CountRange.ONE_TURN


_POSITION_CONTROL = 3  # of Operating Mode (e-manual mx-64-2.md)
_WHEEL, _MULTI_TURN = bytes(4), b"\xff\x0f\xff\x0f"  # both limits 0, both 4095 (mx-64.md)


FIRMWARES = {
    1: Firmware(
        PROTOCOL_1,
        {"MX-28": 29, "MX-64": 310},
        36,
        position_bytes=2,
        position_read_bytes=3,
        tick_register=Register(50, 3),
        mode_register=Register(6, 4),
    ),
    2: Firmware(
        PROTOCOL_2,
        {"MX-28": 30, "MX-64": 311},
        132,
        position_bytes=4,
        position_read_bytes=4,
        tick_register=Register(120, 2),
        mode_register=Register(11, 1),
    ),
}
"""Firmwares by protocol version."""


def find_model(model_number: int) -> tuple[str, int] | None:
    """Look up a model's name and protocol by its number; None if it is no MX-28 or MX-64."""
    for version, firmware in FIRMWARES.items():
        for name, its_number in firmware.model_numbers.items():
            if its_number == model_number:
                return name, version
    return None

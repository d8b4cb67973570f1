"""Packets of both protocols, byte by byte and in a stream of bytes."""

from __future__ import annotations

import itertools
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.chips.dynamixel.protocol import (
    PROTOCOL_1,
    PROTOCOL_2,
    DynamixelProtocol,
    ErrorFlag,
    Instruction,
    Packet,
    PacketDecoder,
    compute_checksum,
    compute_crc16,
    compute_wire_time_ns,
)

# hardware.md 5.1, from the e-manual
PING_2 = bytes.fromhex("FFFFFD00 01 0300 01 194E")
READ_POSITION_2 = bytes.fromhex("FFFFFD00 01 0700 02 84000400 1D15")
STATUS_OF_1_AT_166 = bytes.fromhex("FFFFFD00 01 0800 55 00 A6000000 8CC0")
STATUS_OF_2_AT_2079 = bytes.fromhex("FFFFFD00 02 0800 55 00 1F080000 BABE")
SYNC_READ_1_2 = bytes.fromhex("FFFFFD00 FE 0900 82 84000400 0102 CEFA")
PING_1 = bytes.fromhex("FFFF 01 02 01 FB")
PONG_1 = bytes.fromhex("FFFF 01 02 00 FC")
READ_POSITION_1 = bytes.fromhex("FFFF 01 04 02 24 02 D2")
STATUS_ERROR_24 = bytes.fromhex("FFFF 01 02 24 D8")


@pytest.mark.parametrize(
    ("packet", "golden"),
    [
        (PROTOCOL_2.encode_identity_request(1), PING_2),
        (PROTOCOL_2.encode_read_request(1, 132, 4), READ_POSITION_2),
        (PROTOCOL_2.encode_packet(1, Instruction.STATUS, b"\0\xa6\0\0\0"), STATUS_OF_1_AT_166),
        (PROTOCOL_2.encode_packet(2, Instruction.STATUS, b"\0\x1f\x08\0\0"), STATUS_OF_2_AT_2079),
        (PROTOCOL_2.encode_packet(0xFE, Instruction.SYNC_READ, b"\x84\0\4\0\1\2"), SYNC_READ_1_2),
        (PROTOCOL_1.encode_read_request(1, 36, 2), READ_POSITION_1),
        (PROTOCOL_1.encode_packet(1, ErrorFlag.OVERHEAT | ErrorFlag.OVERLOAD), STATUS_ERROR_24),
        (PROTOCOL_1.encode_packet(1, Instruction.PING), PING_1),
        (PROTOCOL_1.encode_packet(1, ErrorFlag(0)), PONG_1),
    ],
    ids=[
        *("ping", "read", "status of 1", "status of 2", "sync read"),
        *("read in 1.0", "error in 1.0", "ping in 1.0", "answer to a ping in 1.0"),
    ],
)
def test_an_encoded_packet_is_the_golden_one(packet: bytes, golden: bytes) -> None:
    assert packet == golden


def test_checksums_are_those_of_the_manual() -> None:
    assert (compute_crc16(b"123456789"), compute_crc16(b"")) == (0xFEE8, 0)
    assert compute_checksum(bytes.fromhex("01 04 02 24 02")) == 0xD2
    assert compute_checksum(b"") == 0xFF
    assert compute_checksum(b"\xff" * 300) == (~(255 * 300)) & 0xFF


@pytest.mark.parametrize(
    ("protocol", "golden", "packet", "data", "has_alert"),
    [
        (
            PROTOCOL_2,
            STATUS_OF_2_AT_2079,
            Packet(2, 0x55, b"\0\x1f\x08\0\0", True, STATUS_OF_2_AT_2079),
            b"\x1f\x08\0\0",
            False,
        ),
        (PROTOCOL_1, STATUS_ERROR_24, Packet(1, 0x24, b"", True, STATUS_ERROR_24), b"", True),
    ],
    ids=["2.0", "1.0"],
)
def test_a_golden_status_is_decoded(
    protocol: DynamixelProtocol, golden: bytes, packet: Packet, data: bytes, has_alert: bool
) -> None:
    assert protocol.decode_packet(golden) == packet
    status = protocol.decode_answer(packet)
    assert status is not None
    assert (status.packet, status.data) == (packet, data)
    assert (status.has_alert, status.refusal_reason) == (has_alert, "")


@pytest.mark.parametrize("bit", range(8))
def test_every_error_bit_of_protocol_1_is_either_an_alert_or_a_refusal(bit: int) -> None:
    packet = PROTOCOL_1.decode_packet(PROTOCOL_1.encode_packet(1, 1 << bit, b"ab"))
    status = PROTOCOL_1.decode_answer(packet)
    assert status is not None
    assert status.has_alert == (bit in (0, 1, 2, 5))
    assert bool(status.refusal_reason) == (not status.has_alert)


def test_an_intact_instruction_is_no_status_and_a_damaged_one_may_be() -> None:
    assert PROTOCOL_2.decode_answer(PROTOCOL_2.decode_packet(PING_2)) is None
    damaged = PROTOCOL_2.decode_answer(PROTOCOL_2.decode_packet(PING_2[:-1] + b"\x00"))
    assert damaged is not None
    assert not damaged.packet.is_intact


def test_a_header_within_the_parameters_is_stuffed_and_counted_in_the_length() -> None:
    packet = PROTOCOL_2.encode_packet(1, 0x55, bytes.fromhex("00 FFFFFD00"))
    assert packet[:-2] == bytes.fromhex("FFFFFD00 01 0900 55 00 FFFFFDFD00")
    assert compute_crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little")
    assert PROTOCOL_2.decode_packet(packet).parameters == bytes.fromhex("00 FFFFFD00")


@pytest.mark.parametrize(
    ("protocol", "preamble"),
    [
        (PROTOCOL_2, "FFFFFD00 01 0000"),
        (PROTOCOL_2, "FFFFFD00 01 0200"),
        (PROTOCOL_2, "FFFFFD00 01 0104"),
        (PROTOCOL_2, "FFFFFD00 01 FFFF"),
        (PROTOCOL_1, "FFFF FF 02"),
        (PROTOCOL_1, "FFFF 01 00"),
        (PROTOCOL_1, "FFFF 01 01"),
        (PROTOCOL_1, "FFFF 01 4D"),
        (PROTOCOL_1, "FFFFFD00"),  # a request of 2.0: FD is an id here, and the length is 0
    ],
)
def test_a_preamble_of_no_packet_is_noise(protocol: DynamixelProtocol, preamble: str) -> None:
    assert protocol.compute_packet_size(bytes.fromhex(preamble)) == 0


def test_the_wire_time_is_ten_bits_to_the_byte() -> None:
    assert compute_wire_time_ns(15, 1_000_000) == 150_000
    assert compute_wire_time_ns(14, 57_600) == 2_430_555


# Streams of bytes

protocols = st.sampled_from([PROTOCOL_1, PROTOCOL_2])

# The bytes of headers, of stuffing and of their near misses are frequent.
awkward = st.lists(
    st.sampled_from([b"\xff", b"\xfd", b"\x00", b"\xff\xff\xfd", b"\xff\xff\xfd\x00", b"\x55"])
    | st.binary(min_size=1, max_size=3),
    max_size=20,
).map(b"".join)


def noise_of(protocol: DynamixelProtocol) -> st.SearchStrategy[bytes]:
    """Return noise without a header. A header's length counts until its checksum is wrong."""
    if protocol is PROTOCOL_2:
        return awkward.filter(lambda data: protocol.header not in data)
    # The header of 1.0 is any two FF, but not before a third one or a length of 0.
    quiet = awkward.map(lambda data: re.sub(rb"\xff{2,}", b"\xff", data))
    return st.builds(lambda data, run: data.rstrip(b"\xff") + run, quiet, st.just(b"\xff" * 5)) | (
        quiet.map(lambda data: data.replace(b"\xff", b"\xfe"))
    )


@given(data=st.data(), protocol=protocols, parameters=awkward)
def test_any_packet_after_noise_is_decoded_in_any_pieces(
    data: st.DataObject, protocol: DynamixelProtocol, parameters: bytes
) -> None:
    servo_id = data.draw(st.integers(0, protocol.max_servo_id))
    instruction = data.draw(st.integers(0, 255))
    packet = protocol.encode_packet(servo_id, instruction, parameters)
    stream = data.draw(noise_of(protocol)) + packet
    cuts = data.draw(st.lists(st.integers(0, 200)))
    edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    decoder = PacketDecoder(protocol)
    found = []
    for begin, end in itertools.pairwise(edges):
        found += decoder.decode_bytes(stream[begin:end])
    assert found == [Packet(servo_id, instruction, parameters, True, packet)]


@given(data=st.data(), protocol=protocols, parameters=awkward)
def test_the_missing_bytes_never_extend_beyond_the_packet(
    data: st.DataObject, protocol: DynamixelProtocol, parameters: bytes
) -> None:
    stream = data.draw(noise_of(protocol)) + protocol.encode_packet(1, 0x55, parameters)
    decoder, found, at = PacketDecoder(protocol), list[Packet](), 0
    while not found:
        assert 0 < decoder.min_missing_bytes <= len(stream) - at
        n = decoder.min_missing_bytes
        found = decoder.decode_bytes(stream[at : at + n])
        at += n
    assert at == len(stream)


@given(protocol=protocols, noise=st.binary(max_size=600) | awkward)
def test_a_packet_is_found_after_any_noise(protocol: DynamixelProtocol, noise: bytes) -> None:
    decoder = PacketDecoder(protocol)
    decoder.decode_bytes(noise)
    assert decoder.min_missing_bytes > 0
    packet = protocol.encode_packet(1, 0, b"\x07")
    # Enough of them for the longest length that noise can announce.
    assert Packet(1, 0, b"\x07", True, packet) in decoder.decode_bytes(packet * 150)


@pytest.mark.parametrize(
    ("protocol", "noise", "intact"),
    [
        (PROTOCOL_2, "FFFFFD00 01 0F00 55", [False, True]),
        (PROTOCOL_2, "FFFFFD00 01 FFFF", [True]),
        (PROTOCOL_1, "FFFF 01 04", [False, True]),
        (PROTOCOL_1, "FFFF 01 FE", [True]),
    ],
)
def test_a_header_of_noise_does_not_hide_the_packet_after_it(
    protocol: DynamixelProtocol, noise: str, intact: list[bool]
) -> None:
    answer = STATUS_OF_1_AT_166 if protocol is PROTOCOL_2 else PONG_1
    found = PacketDecoder(protocol).decode_bytes(bytes.fromhex(noise) + answer)
    assert [packet.is_intact for packet in found] == intact


@pytest.mark.parametrize("protocol", [PROTOCOL_1, PROTOCOL_2], ids=["1.0", "2.0"])
def test_two_packets_in_one_piece_are_two_packets(protocol: DynamixelProtocol) -> None:
    found = PacketDecoder(protocol).decode_bytes(
        protocol.encode_packet(1, 0) + protocol.encode_packet(2, 0, b"x")
    )
    assert [packet.servo_id for packet in found] == [1, 2]

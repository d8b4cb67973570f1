"""Packets in a stream of bytes, in both protocols."""

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
    Packet,
    PacketDecoder,
    compute_wire_time_ns,
)

# hardware.md 5.1
STATUS_OF_1_AT_166 = bytes.fromhex("FFFFFD00 01 0800 55 00 A6000000 8CC0")
STATUS_OF_2_AT_2079 = bytes.fromhex("FFFFFD00 02 0800 55 00 1F080000 BABE")
PONG_1 = bytes.fromhex("FFFF 01 02 00 FC")

protocols = st.sampled_from([PROTOCOL_1, PROTOCOL_2])
both_protocols = pytest.mark.parametrize("protocol", [PROTOCOL_1, PROTOCOL_2], ids=["1.0", "2.0"])

# Bytes of which headers, stuffing and their near misses are made come up often.
awkward = st.lists(
    st.sampled_from([b"\xff", b"\xfd", b"\x00", b"\xff\xff\xfd", b"\xff\xff\xfd\x00", b"\x55"])
    | st.binary(min_size=1, max_size=3),
    max_size=20,
).map(b"".join)


def noise_of(protocol: DynamixelProtocol) -> st.SearchStrategy[bytes]:
    """Noise without a whole header: with one, its length is believed until the sum is wrong."""
    if protocol is PROTOCOL_2:
        return awkward.filter(lambda data: protocol.header not in data)
    # 1.0 has a short header: any two FF, but not if a third follows, or a length of none.
    quiet = awkward.map(lambda data: re.sub(rb"\xff{2,}", b"\xff", data))
    return st.builds(lambda data, run: data.rstrip(b"\xff") + run, quiet, st.just(b"\xff" * 5)) | (
        quiet.map(lambda data: data.replace(b"\xff", b"\xfe"))
    )


@given(data=st.data(), protocol=protocols, parameters=awkward)
def test_any_packet_survives_garbage_in_front_and_any_cuts(
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
def test_asking_for_what_is_missing_never_asks_beyond_the_packet(
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
def test_no_noise_breaks_the_decoder(protocol: DynamixelProtocol, noise: bytes) -> None:
    decoder = PacketDecoder(protocol)
    decoder.decode_bytes(noise)
    assert decoder.min_missing_bytes > 0


@given(protocol=protocols, noise=st.binary(max_size=60) | awkward)
def test_after_any_noise_a_packet_is_found_once_enough_has_come(
    protocol: DynamixelProtocol, noise: bytes
) -> None:
    packet = protocol.encode_packet(1, 0, b"\x07")
    found = PacketDecoder(protocol).decode_bytes(noise + packet * 150)
    assert Packet(1, 0, b"\x07", True, packet) in found


def test_a_header_made_by_noise_does_not_swallow_the_packet_behind_it() -> None:
    false_start = bytes.fromhex("FFFFFD00 01 0F00 55")
    found = PacketDecoder(PROTOCOL_2).decode_bytes(false_start + STATUS_OF_1_AT_166)
    assert [packet.is_intact for packet in found] == [False, True]
    impossible_length = bytes.fromhex("FFFFFD00 01 FFFF")
    (packet,) = PacketDecoder(PROTOCOL_2).decode_bytes(impossible_length + STATUS_OF_1_AT_166)
    assert packet.is_intact
    found = PacketDecoder(PROTOCOL_1).decode_bytes(bytes.fromhex("FFFF 01 04") + PONG_1)
    assert [packet.is_intact for packet in found] == [False, True]
    (packet,) = PacketDecoder(PROTOCOL_1).decode_bytes(bytes.fromhex("FFFF 01 FE") + PONG_1)
    assert packet.is_intact


@both_protocols
def test_two_packets_in_one_piece_are_two_packets(protocol: DynamixelProtocol) -> None:
    found = PacketDecoder(protocol).decode_bytes(
        protocol.encode_packet(1, 0) + protocol.encode_packet(2, 0, b"x")
    )
    assert [packet.servo_id for packet in found] == [1, 2]


def test_wire_time_is_ten_bits_to_the_byte() -> None:
    assert compute_wire_time_ns(15, 1_000_000) == 150_000
    assert compute_wire_time_ns(14, 57_600) == 2_430_555

"""Protocol 2.0 byte by byte."""

from __future__ import annotations

import pytest

from devices.chips.dynamixel.protocol import PROTOCOL_2, Instruction, Packet, compute_crc16

# hardware.md 5.1, from the e-manual
PING_1 = bytes.fromhex("FFFFFD00 01 0300 01 194E")
READ_POSITION_OF_1 = bytes.fromhex("FFFFFD00 01 0700 02 84000400 1D15")
STATUS_OF_1_AT_166 = bytes.fromhex("FFFFFD00 01 0800 55 00 A6000000 8CC0")
STATUS_OF_2_AT_2079 = bytes.fromhex("FFFFFD00 02 0800 55 00 1F080000 BABE")
SYNC_READ_1_2 = bytes.fromhex("FFFFFD00 FE 0900 82 84000400 0102 CEFA")


def test_the_crc_is_the_one_of_the_manual() -> None:
    assert compute_crc16(b"123456789") == 0xFEE8
    assert compute_crc16(b"") == 0


@pytest.mark.parametrize(
    ("packet", "golden"),
    [
        (PROTOCOL_2.encode_identity_request(1), PING_1),
        (PROTOCOL_2.encode_read_request(1, 132, 4), READ_POSITION_OF_1),
        (PROTOCOL_2.encode_packet(1, Instruction.STATUS, b"\0\xa6\0\0\0"), STATUS_OF_1_AT_166),
        (PROTOCOL_2.encode_packet(2, Instruction.STATUS, b"\0\x1f\x08\0\0"), STATUS_OF_2_AT_2079),
        (PROTOCOL_2.encode_packet(0xFE, Instruction.SYNC_READ, b"\x84\0\4\0\1\2"), SYNC_READ_1_2),
    ],
    ids=["ping", "read", "status of 1", "status of 2", "sync read"],
)
def test_the_golden_packets_are_reproduced_byte_for_byte(packet: bytes, golden: bytes) -> None:
    assert packet == golden


def test_a_golden_status_is_unpacked() -> None:
    packet = PROTOCOL_2.decode_packet(STATUS_OF_2_AT_2079)
    expected = Packet(2, 0x55, bytes([0, 0x1F, 0x08, 0, 0]), True, STATUS_OF_2_AT_2079)
    assert packet == expected
    status = PROTOCOL_2.decode_answer(packet)
    assert status is not None
    assert (status.packet.servo_id, status.data, status.has_alert, status.refusal_reason) == (
        2,
        b"\x1f\x08\x00\x00",
        False,
        "",
    )


def test_a_whole_instruction_is_no_status_and_a_damaged_one_may_have_been() -> None:
    assert PROTOCOL_2.decode_answer(PROTOCOL_2.decode_packet(PING_1)) is None
    damaged = PROTOCOL_2.decode_answer(PROTOCOL_2.decode_packet(PING_1[:-1] + b"\x00"))
    assert damaged is not None
    assert not damaged.packet.is_intact


def test_a_header_within_the_parameters_is_stuffed_and_counted_in_the_length() -> None:
    packet = PROTOCOL_2.encode_packet(1, 0x55, bytes.fromhex("00 FFFFFD00"))
    assert packet[:-2] == bytes.fromhex("FFFFFD00 01 0900 55 00 FFFFFDFD00")
    assert compute_crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little")
    assert PROTOCOL_2.decode_packet(packet).parameters == bytes.fromhex("00 FFFFFD00")


@pytest.mark.parametrize("length", [0, 2, 1025, 0xFFFF])
def test_a_length_that_no_packet_has_is_noise(length: int) -> None:
    assert (
        PROTOCOL_2.compute_packet_size(b"\xff\xff\xfd\x00\x01" + length.to_bytes(2, "little")) == 0
    )

"""Protocol 1.0 byte by byte."""

from __future__ import annotations

import pytest

from devices.chips.dynamixel.protocol import (
    PROTOCOL_1,
    ErrorFlag,
    Instruction,
    Packet,
    compute_checksum,
)

# hardware.md 5.1
READ_POSITION_OF_1 = bytes.fromhex("FFFF 01 04 02 24 02 D2")
STATUS_ERROR_24 = bytes.fromhex("FFFF 01 02 24 D8")
PING_1 = bytes.fromhex("FFFF 01 02 01 FB")
PONG_1 = bytes.fromhex("FFFF 01 02 00 FC")


def test_the_checksum_is_the_inverted_sum() -> None:
    assert compute_checksum(bytes.fromhex("01 04 02 24 02")) == 0xD2
    assert compute_checksum(b"") == 0xFF
    assert compute_checksum(b"\xff" * 300) == (~(255 * 300)) & 0xFF


@pytest.mark.parametrize(
    ("packet", "golden"),
    [
        (PROTOCOL_1.encode_read_request(1, 36, 2), READ_POSITION_OF_1),
        (PROTOCOL_1.encode_packet(1, ErrorFlag.OVERHEAT | ErrorFlag.OVERLOAD), STATUS_ERROR_24),
        (PROTOCOL_1.encode_packet(1, Instruction.PING), PING_1),
        (PROTOCOL_1.encode_packet(1, ErrorFlag(0)), PONG_1),
    ],
    ids=["read", "error", "ping", "answer to a ping"],
)
def test_the_golden_packets_are_reproduced_byte_for_byte(packet: bytes, golden: bytes) -> None:
    assert packet == golden


def test_a_golden_status_is_unpacked() -> None:
    packet = PROTOCOL_1.decode_packet(STATUS_ERROR_24)
    assert packet == Packet(1, 0x24, b"", True, STATUS_ERROR_24)
    status = PROTOCOL_1.decode_answer(packet)
    assert status is not None
    assert (status.packet.servo_id, status.data, status.has_alert, status.refusal_reason) == (
        1,
        b"",
        True,
        "",
    )


@pytest.mark.parametrize("bit", range(8))
def test_every_error_bit_is_an_alert_or_a_refusal_and_never_both(bit: int) -> None:
    status = PROTOCOL_1.decode_answer(
        PROTOCOL_1.decode_packet(PROTOCOL_1.encode_packet(1, 1 << bit, b"ab"))
    )
    assert status is not None
    assert status.has_alert == (bit in (0, 1, 2, 5))
    assert bool(status.refusal_reason) == (not status.has_alert)


@pytest.mark.parametrize("preamble", ["FFFF FF 02", "FFFF 01 00", "FFFF 01 01", "FFFF 01 4D"])
def test_what_no_packet_begins_with_is_noise(preamble: str) -> None:
    assert PROTOCOL_1.compute_packet_size(bytes.fromhex(preamble)) == 0


def test_a_request_of_protocol_2_is_noise_to_protocol_1() -> None:
    # FD is an id here, and the length is 0: the header of 2.0 was made so.
    assert PROTOCOL_1.compute_packet_size(bytes.fromhex("FFFFFD00")) == 0

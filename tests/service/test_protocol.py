"""Messages of the link: what was damaged on its way is not heard, what cannot be not understood."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.types import OFFSET_NS_END, T_MONO_NS_END
from devices.vitals import Vitals
from service.protocol.codec import (
    CloseConnection,
    append_crc,
    append_text_crc,
    decode_link_message,
    encode_link_message,
    format_close_reason,
    strip_binary_crc,
    strip_text_crc,
)
from service.protocol.link import (
    NODE_MESSAGES,
    PROTOCOL,
    SERVER_MESSAGES,
    UNCERTAINTY_MAX_NS,
    Ack,
    Challenge,
    ClockProbe,
    ClockSample,
    EarlierStream,
    Hello,
    Identify,
    LinkMessage,
    LossReport,
    NodeStatus,
    Proof,
    RetentionMessage,
    StreamNumbers,
    StreamSelect,
    Welcome,
)
from storage.clock.log import ClockOffset
from storage.clock.table import ClockTable, StreamClockFacts, group_rows_by_stream_in_given_order
from tests.builders.arrays import make_array, make_servo
from tests.builders.calibrations import make_calibration, make_effects, newton_tile
from tests.builders.odd_values import ODD_VALUES, places, with_value

CLOCK_ENDS = (T_MONO_NS_END - 1, OFFSET_NS_END - 1, UNCERTAINTY_MAX_NS)
ACK = Ack(stream_id="0" * 32, seq_first=100, seq_last=199)
WANTED = RetentionMessage(
    streams=(StreamNumbers(stream_id="a" * 32, numbers=((5, 9), (0, 3), (20, None))),),
    recording=True,
)
HELLO = Hello(
    protocol=PROTOCOL,
    array_info=make_array(servo=make_servo()),
    stored=((0, 99), (200, 299)),
    next_seq=300,
    t_mono_ns=-5,
    lost={"evicted": ((100, 199),)},
    scene={"name": "test", "tile": [{"x_m": 0.5, "on": True, "note": None, "n": 7}]},
    emulated=False,
    calibration=make_calibration(newton_tile("T01", effects=make_effects()), "T02"),
    calibration_problem=None,
    earlier=(
        EarlierStream(
            array_info=make_array(stream_id="b" * 32),
            stored=((0, 9),),
            next_seq=10,
            lost={"disk_full": ((3, 4),)},
            max_lost_tail_frames=7,
            t_ns_first=10**18,
        ),
    ),
)
FROM_NODE = (
    HELLO,
    Identify(protocol=PROTOCOL, node="leg"),
    Proof(proof="0" * 64, secret="f" * 64),
    StreamSelect(stream_id="b" * 32),
    ClockProbe(id=3),
    ClockSample(t_mono_ns=5, server_minus_node_ns=-77, uncertainty_ns=9),
    LossReport(stream_id="b" * 32, lost={"node_busy": ((0, 0), (5, 6))}),
    NodeStatus(
        missed_slots=3,
        warnings=("T01: does not answer",),
        counts={"T01": {"stale": 4}},
        vitals=Vitals(disk_free_bytes=10**9, recording_left_s=3e4, wifi_dbm=-61, is_throttled=True),
    ),
)
FROM_SERVER = (
    ACK,
    WANTED,
    Challenge(protocol=PROTOCOL, server_id="e" * 32, nonce="0" * 64, is_known=True),
    Welcome(protocol=PROTOCOL, missing=WANTED.streams, retention=WANTED),
    ClockProbe(id=3, server_t_ns=10**18),
)
MESSAGES: tuple[tuple[Any, LinkMessage], ...] = (
    *((NODE_MESSAGES, message) for message in FROM_NODE),
    *((SERVER_MESSAGES, message) for message in FROM_SERVER),
)


def decode(content: Any, messages: Any = NODE_MESSAGES) -> LinkMessage:
    taken: LinkMessage = decode_link_message(messages, append_text_crc(json.dumps(content)))
    return taken


def assert_taken_as_it_is_or_refused(content: Any, messages: Any) -> None:
    try:
        taken = decode(content, messages)
    except CloseConnection:
        return
    written = encode_link_message(taken)
    assert decode_link_message(messages, written) == taken
    assert encode_link_message(decode_link_message(messages, written)) == written
    json.loads(written, parse_constant=pytest.fail)  # no NaN, which JSON has not
    assert messages.validate_python(taken.model_dump()) == taken
    written.encode()


def test_a_message_is_json_and_comes_back() -> None:
    assert json.loads(encode_link_message(ACK))["seq_last"] == 199
    for messages, message in MESSAGES:
        assert decode_link_message(messages, encode_link_message(message)) == message


@pytest.mark.parametrize(
    ("messages", "message"),
    [
        *((SERVER_MESSAGES, message) for message in FROM_NODE if message.type != "probe"),
        *((NODE_MESSAGES, message) for message in FROM_SERVER if message.type != "probe"),
    ],
    ids=lambda value: getattr(value, "type", ""),
)
def test_a_message_of_the_other_side_is_not_understood(messages: Any, message: Any) -> None:
    with pytest.raises(CloseConnection, match=f"not understood: Input tag '{message.type}'"):
        decode_link_message(messages, encode_link_message(message))


@pytest.mark.parametrize("place", [("missing",), ("retention", "streams")], ids=str)
def test_a_request_of_too_many_streams_is_not_understood(place: tuple[str, ...]) -> None:
    content = json.loads(FROM_SERVER[-2].model_dump_json())
    streams = [{"stream_id": "a" * 32, "numbers": []}] * (1 << 14)
    decode(with_value(content, place, streams), SERVER_MESSAGES)
    with pytest.raises(CloseConnection, match="at most 16384"):
        decode(with_value(content, place, [*streams, streams[0]]), SERVER_MESSAGES)


@pytest.mark.slow
@settings(deadline=None, max_examples=1500)
@given(data=st.data())
def test_what_is_taken_can_be_written_down_and_read_back_as_the_same(data: st.DataObject) -> None:
    """Any one or two values of any message replaced by what JSON, and Python's JSON, can say."""
    at = data.draw(st.integers(0, len(MESSAGES) - 1))
    messages, message = MESSAGES[at]
    content = json.loads(message.model_dump_json())
    for _ in range(data.draw(st.integers(1, 2))):
        found = list(places(content))
        place = found[data.draw(st.integers(0, len(found) - 1))]
        value = ODD_VALUES[data.draw(st.integers(0, len(ODD_VALUES) - 1))]
        content = with_value(content, place, value)
    assert_taken_as_it_is_or_refused(content, messages)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("array_info", "tiles", 0, "conversion_ms"), math.nan),
        (("array_info", "tiles", 0, "conversion_ms"), 0.0),
        (("array_info", "tiles", 0, "conversion_ms"), -1.6),
        (("array_info", "tiles", 0, "x_m"), math.inf),
        (("array_info", "tiles", 0, "y_m"), 14.0),
        (("array_info", "tiles", 0, "registers", 1), 70_000),
        (("array_info", "tiles", 0, "registers", 1), -1),
        (("array_info", "tiles", 0, "registers"), [1, 2, 3]),
        (("array_info", "tiles", 0, "chip"), "bmp999"),
        (("array_info", "tiles", 0, "serial"), "T02"),
        (("array_info", "tiles", 0, "serial"), "T01\n"),
        (("array_info", "nominal_rate_hz"), math.nan),
        (("array_info", "nominal_rate_hz"), 0.0),
        (("array_info", "nominal_rate_hz"), 1e9),
        (("array_info", "utc_offset_ns"), 2**63),
        (("array_info", "software"), "x" * 1000),
        (("array_info", "clock_set"), 1),
        (("array_info", "servo", "ratio"), math.nan),
        (("calibration", "tiles", 0, "f_scale_n"), math.inf),
        (("calibration", "tiles", 0, "coefficients", 3), 1e308),
        (("calibration", "tiles", 0, "registers"), [70_000, 0, 0, 0]),
        (("calibration", "tiles", 0, "effects", "gas", "tau_s", "sigma"), math.nan),
        (("scene", "tile", 0, "x_m"), math.nan),
        (("scene", "name"), "a\x1b[31m"),
        (("scene", "name"), 2**64),
        (("stored",), [[0, 2**53]]),
        (("stored",), [[5, 9], [0, 3]]),
        (("stored",), [[-1, 5]]),
        (("stored",), [[0]]),
        (("lost",), {"x": [[0, 4611686018427387903]]}),
        (("lost",), {"Evicted!": [[0, 1]]}),
        (("earlier",), [{}]),
        (("protocol",), "one"),
        (("calibration",), {"version": 1}),
        (("scene",), []),
        (("next_seq",), 2**53),
        (("next_seq",), True),
        (("earlier", 0, "t_ns_first"), -1),
        (("calibration_problem",), "\x07"),
    ],
    ids=str,
)
def test_a_hello_with_a_value_that_cannot_be_is_not_understood(
    place: tuple[Any, ...], value: Any
) -> None:
    content = with_value(json.loads(HELLO.model_dump_json()), place, value)
    with pytest.raises(CloseConnection, match="not understood") as refused:
        decode(content)
    assert str(place[0]) in str(refused.value)


@pytest.mark.parametrize(
    "scene",
    [
        json.loads("[" * 20 + "]" * 20),
        {str(i): "x" * 9000 for i in range(40)},
        {"x" * 300: 1},
    ],
    ids=["deep", "long", "key"],
)
def test_a_scene_beyond_all_bounds_is_not_understood(scene: Any) -> None:
    content = json.loads(HELLO.model_dump_json()) | {"scene": {"a": scene}}
    with pytest.raises(CloseConnection, match="scene"):
        decode(content)


def test_half_a_surrogate_pair_is_not_understood() -> None:
    with pytest.raises(CloseConnection):
        decode(json.loads(HELLO.model_dump_json()) | {"scene": {"a": "\ud800"}})


@given(st.text())
def test_a_reason_fits_into_a_close_frame_and_a_line_of_a_log(text: str) -> None:
    reason = format_close_reason(text)
    assert len(reason.encode()) <= 123
    assert reason.isprintable()


@given(at=st.integers(0, len(encode_link_message(ACK)) - 1), bit=st.integers(0, 7))
def test_a_flipped_bit_of_a_text_is_noticed_wherever_it_is(at: int, bit: int) -> None:
    """A 1 that became a 9 would have the node forget frames that nobody has."""
    damaged = bytearray(encode_link_message(ACK).encode())
    damaged[at] ^= 1 << bit
    with pytest.raises(CloseConnection, match="damaged"):
        strip_text_crc(bytes(damaged))


@given(payload=st.binary(max_size=300), data=st.data())
def test_a_flipped_bit_of_frames_is_noticed_wherever_it_is(
    payload: bytes, data: st.DataObject
) -> None:
    message = bytearray(append_crc(payload))
    assert strip_binary_crc(bytes(message)) == payload
    message[data.draw(st.integers(0, len(message) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(CloseConnection, match="damaged"):
        strip_binary_crc(bytes(message))


@pytest.mark.parametrize("message", [b"", b"abc", b"abcd"])
def test_what_is_too_short_is_damaged(message: bytes) -> None:
    with pytest.raises(CloseConnection):
        strip_binary_crc(message)


@settings(max_examples=300)
@given(
    st.lists(
        st.tuples(
            *(st.one_of(st.integers(-end, end), st.sampled_from([-end, end])) for end in CLOCK_ENDS)
        ),
        min_size=1,
        max_size=4,
        unique_by=lambda row: row[0],
    )
)
def test_every_clock_row_that_is_taken_in_can_be_read_again(
    measured: list[tuple[int, int, int]],
) -> None:
    rows = []
    for t_mono_ns, offset_ns, uncertainty_ns in measured:
        taken_in = ClockSample(
            t_mono_ns=t_mono_ns,
            server_minus_node_ns=offset_ns,
            uncertainty_ns=abs(uncertainty_ns),
        )
        rows.append(ClockOffset(stream_id="b", **taken_in.model_dump(exclude={"type"})))
    table = ClockTable(group_rows_by_stream_in_given_order(rows), [StreamClockFacts("b", 0)], ["b"])
    table.summarize_streams().model_dump_json()
    for row in rows:
        columns = table.compute_server_time_columns_or_unknown(
            np.array([row.t_mono_ns]), np.array([0]), None
        )
        away_ns = abs(int(columns["t_server_ns"][0]) - row.server_minus_node_ns)
        # The truth is within the bounds of both; the rates of decades round to a nanosecond.
        bound_ns = int(columns["t_server_uncertainty_ns"][0]) + 1.001 * row.uncertainty_ns
        assert away_ns <= bound_ns + 2

"""Messages read at once are the messages read one by one; where one is not, nothing is read."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate, pairwise

import numpy as np
import pyarrow as pa
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.frames import FrameBatch
from devices.types import SEQ_END
from storage.schema import frames_to_record_batch, wire_schema
from storage.wire import MessageBatch, MessageBatchDecoder, decode_message, encode_frames
from tests.builders.arrays import make_array
from tests.builders.frames import any_frames, assert_same_bits

ROWS = 60
TILES = 3
SCHEMA = wire_schema(make_array(TILES))


def frames(rows: int = ROWS, tiles: int = TILES, *, first: int = 0) -> FrameBatch:
    """Any bits at all in columns without a law; `seq` and time rise."""
    t_mono_ns = np.sort(np.random.default_rng(rows).integers(-(2**61), 2**61, rows))
    seq = np.arange(first, first + rows)
    return any_frames(rows, tiles, rows, seq=seq, t_mono_ns=t_mono_ns)


def run_of(batches: Sequence[FrameBatch], payloads: Sequence[bytes] | None = None) -> MessageBatch:
    """The batches as an index says them, and the bytes that are there."""
    if payloads is None:
        payloads = [encode_frames(batch, SCHEMA) for batch in batches]
    return MessageBatch(
        content=b"".join(payloads),
        length=np.array([len(payload) for payload in payloads], "<u4"),
        seq_first=np.array([batch.seq[0] for batch in batches], "<u8"),
        count=np.array([len(batch) for batch in batches], "<u4"),
        crc32=np.array([zlib.crc32(payload) for payload in payloads], "<u4"),
    )


def cut(batch: FrameBatch, cuts: Sequence[int]) -> list[FrameBatch]:
    return [batch.slice_rows(a, b) for a, b in pairwise(sorted({0, *cuts, len(batch)}))]


def is_read(batches: Sequence[FrameBatch], payloads: Sequence[bytes] | None = None) -> bool:
    return (
        MessageBatchDecoder(SCHEMA).decode_or_none_if_damaged(run_of(batches, payloads)) is not None
    )


cuts = st.lists(st.integers(0, ROWS), max_size=8)


@settings(deadline=None, max_examples=50)
@given(cuts=cuts, left_out=st.sets(st.integers(0, 8)), tiles=st.sampled_from([1, 3, 64]))
def test_messages_read_at_once_are_those_read_one_by_one(
    cuts: list[int], left_out: set[int], tiles: int
) -> None:
    schema = wire_schema(make_array(tiles))
    parts = cut(frames(tiles=tiles), cuts)
    parts = [part for at, part in enumerate(parts) if at not in left_out] or parts
    payloads = [encode_frames(part, schema) for part in parts]
    reader = MessageBatchDecoder(schema)
    for _ in range(2):  # the second time headers are known
        read = reader.decode_or_none_if_damaged(run_of(parts, payloads))
        assert read is not None
        one_by_one = [decode_message(payload, schema) for payload in payloads]
        assert_same_bits(read, FrameBatch.concatenate(one_by_one))


def test_more_headers_than_are_remembered_are_read() -> None:
    sizes = list(range(1, 300))
    parts = cut(frames(sum(sizes)), list(accumulate(sizes)))
    read = MessageBatchDecoder(SCHEMA).decode_or_none_if_damaged(run_of(parts))
    assert read is not None
    assert_same_bits(read, frames(sum(sizes)))


@settings(deadline=None)
@given(cuts=cuts, data=st.data())
def test_no_flipped_bit_is_read(cuts: list[int], data: st.DataObject) -> None:
    run = run_of(cut(frames(), cuts))
    damaged = bytearray(run.content)
    damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    assert (
        MessageBatchDecoder(SCHEMA).decode_or_none_if_damaged(replace(run, content=bytes(damaged)))
        is None
    )


@given(behind=st.integers(-200, 200).filter(bool))
def test_bytes_that_are_too_few_or_too_many_are_not_read(behind: int) -> None:
    run = run_of(cut(frames(), [20, 40]))
    content = run.content + bytes(behind) if behind > 0 else run.content[:behind]
    assert (
        MessageBatchDecoder(SCHEMA).decode_or_none_if_damaged(replace(run, content=content)) is None
    )


def test_nothing_is_no_run() -> None:
    assert MessageBatchDecoder(SCHEMA).decode_or_none_if_damaged(run_of([])) is None


def test_an_index_that_says_other_numbers_than_the_messages_is_not_followed() -> None:
    run = run_of(cut(frames(), [20, 40]))
    reader = MessageBatchDecoder(SCHEMA)
    assert reader.decode_or_none_if_damaged(run) is not None
    for wrong in ([0, 20, 41], [0, 19, 40], [1, 20, 40], [2**63, 20, 40]):
        assert (
            reader.decode_or_none_if_damaged(replace(run, seq_first=np.array(wrong, "<u8"))) is None
        )
    for count in ([20, 20, 21], [20, 20, 19], [21, 19, 20], [20, 0, 40]):
        assert reader.decode_or_none_if_damaged(replace(run, count=np.array(count, "<u4"))) is None
    length = run.length + np.array([8, 0, -8])
    assert reader.decode_or_none_if_damaged(replace(run, length=length)) is None


def test_messages_that_overlap_or_come_in_another_order_are_not_read() -> None:
    whole = frames()
    for spans in ([(0, 20), (19, 40)], [(20, 40), (0, 20)], [(0, 20), (0, 20)]):
        assert not is_read([whole.slice_rows(*span) for span in spans])


def test_time_may_run_back_between_messages_only() -> None:
    whole = frames()
    t_mono_ns = whole.t_mono_ns.copy()
    t_mono_ns[30] = t_mono_ns[19]
    back = replace(whole, t_mono_ns=t_mono_ns)
    assert not is_read(cut(back, [20, 40]))
    assert is_read(cut(back, [20, 30, 40]))  # `decode_message` sees no more: it is asked elsewhere


def test_numbers_that_do_not_rise_by_one_within_a_message_are_not_read() -> None:
    whole = frames()
    for seq in ([20, 22, 21], [20, 20, 21], [20, 21, 23]):
        changed = whole.seq.copy()
        changed[20:23] = seq
        assert not is_read(cut(replace(whole, seq=changed), [20, 40]))


def test_numbers_that_no_stream_reaches_are_not_read() -> None:
    assert is_read(cut(frames(first=SEQ_END - ROWS), [20]))
    assert not is_read(cut(frames(first=SEQ_END - ROWS + 1), [20]))
    assert not is_read(cut(frames(first=2**62), [20]))


def test_a_message_that_is_none_of_this_stream_is_not_read_whatever_its_checksum() -> None:
    parts = cut(frames(), [20, 40])
    payloads = [encode_frames(part, SCHEMA) for part in parts]
    foreign = encode_frames(frames(tiles=2).slice_rows(20, 40), wire_schema(make_array(2)))
    sink = pa.BufferOutputStream()
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    with pa.ipc.new_stream(sink, SCHEMA, options=options) as writer:
        writer.write_batch(frames_to_record_batch(parts[1], SCHEMA))
    packed = sink.getvalue().to_pybytes()[len(SCHEMA.serialize()) : -8]
    longer = payloads[1] + bytes(8)
    for message in (foreign, packed, longer, b"PAR1" * 50, b"\xff\xff\xff\xff\0\0\0\0", b"", b"\0"):
        assert not is_read(parts, [payloads[0], message, payloads[2]])


def test_a_legacy_message_is_not_read_from_beside_its_columns() -> None:
    """A number and an instant that are zeros where the next column is taken for this one."""
    one = replace(frames(1), seq=np.zeros(1, np.uint64), t_mono_ns=np.array([1 << 32]))
    payload = encode_frames(one, SCHEMA)[4:] + bytes(4)
    assert not is_read([one], [payload])


def test_headers_of_strangers_take_no_memory() -> None:
    reader, part = MessageBatchDecoder(SCHEMA), frames(5)
    for number in range(20):
        payload = padded(encode_frames(part, SCHEMA), 100_000 + 8 * number)
        assert_same_bits(decode_message(payload, SCHEMA), part)
        read = reader.decode_or_none_if_damaged(run_of([part], [payload]))
        assert read is not None
        assert_same_bits(read, part)
    assert sum(len(head) for head in reader._layouts._cache) < 100_000


def padded(payload: bytes, more: int) -> bytes:
    """The message with so many bytes behind its header, which says so."""
    begin = 8 + int.from_bytes(payload[4:8], "little")
    length = (begin - 8 + more).to_bytes(4, "little")
    return payload[:4] + length + payload[8:begin] + bytes(more) + payload[begin:]

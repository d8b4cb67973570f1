"""Messages of frames: the same bits at the other end, one by one or at once, and nothing else."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.frames import FrameBatch
from devices.types import SEQ_END
from storage.message_layout import MAX_MESSAGE_FRAMES
from storage.schema import frames_to_record_batch, wire_schema
from storage.wire import MessageBatch, MessageBatchDecoder, decode_message, encode_frames
from tests.builders.arrays import make_array
from tests.builders.frames import any_frames, assert_same_bits


def schema_of(tiles: int) -> pa.Schema:
    return wire_schema(make_array(tiles))


ROWS = 60
TILES = 2
SCHEMA = schema_of(TILES)


def frames(rows: int = ROWS, tiles: int = TILES, seed: int = 0, *, first: int = 0) -> FrameBatch:
    """Any bits at all in columns without a law; `seq` and time rise."""
    t_mono_ns = np.sort(np.random.default_rng(seed).integers(-(2**61), 2**61, rows))
    return any_frames(
        rows,
        tiles,
        seed,
        seq=np.arange(rows, dtype=np.uint64) + np.uint64(first),
        t_mono_ns=t_mono_ns,
    )


def refused(batch: FrameBatch, match: str) -> None:
    schema = schema_of(batch.tile_count)
    with pytest.raises(FileFormatError, match=match):
        decode_message(encode_frames(batch, schema), schema)


# --- the same at both ends ------------------------------------------------------------------------


@given(
    rows=st.integers(1, 40),
    tiles=st.integers(1, 9),
    seed=st.integers(0, 2**32 - 1),
    first=st.sampled_from([0, 1, 10**12, 2**53 - 40]),
)
def test_frames_survive_the_wire_bit_by_bit(rows: int, tiles: int, seed: int, first: int) -> None:
    batch, schema = frames(rows, tiles, seed, first=first), schema_of(tiles)
    payload = encode_frames(batch, schema)
    assert_same_bits(decode_message(payload, schema), batch)
    assert_same_bits(decode_message(memoryview(bytearray(payload)), schema), batch)


def test_the_same_frames_are_the_same_bytes() -> None:
    schema, batch = schema_of(2), frames(20)
    alone = replace(batch.slice_rows(5, 9), seq=np.arange(5, 9, dtype=np.uint64))
    assert encode_frames(batch.slice_rows(5, 9), schema) == encode_frames(alone, schema)


def test_frames_of_one_instant_and_the_longest_message_are_taken() -> None:
    schema = schema_of(1)
    batch = replace(
        frames(MAX_MESSAGE_FRAMES, 1), t_mono_ns=np.full(MAX_MESSAGE_FRAMES, 7, dtype=np.int64)
    )
    assert_same_bits(decode_message(encode_frames(batch, schema), schema), batch)


# --- refused --------------------------------------------------------------------------------------


def test_a_message_that_is_cut_off_anywhere_is_refused() -> None:
    schema = schema_of(2)
    payload = encode_frames(frames(3), schema)
    for length in range(len(payload)):
        with pytest.raises(FileFormatError):
            decode_message(payload[:length], schema)


def test_no_damage_does_more_than_be_refused() -> None:
    """Flipped, overwritten, removed and repeated bytes, most of them where Arrow keeps lengths."""
    rng, schema = np.random.default_rng(1), schema_of(2)
    payload = encode_frames(frames(5), schema)
    refusals = 0
    for _ in range(1500):
        damaged = bytearray(payload)
        for _ in range(int(rng.integers(1, 4))):
            begin = 0 if rng.random() < 0.1 else 8
            at = int(rng.integers(begin, len(damaged) if rng.random() < 0.2 else 600))
            kind = rng.integers(5)
            if kind == 0:
                damaged[at] ^= 1 << int(rng.integers(8))
            elif kind == 1:
                damaged[at] = int(rng.choice([0, 1, 127, 128, 255]))
            elif kind == 2:
                damaged[at : at + 8] = rng.bytes(8)
            elif kind == 3:
                del damaged[at : at + int(rng.integers(1, 9))]
            else:
                damaged[at:at] = damaged[at : at + int(rng.integers(1, 9))]
        try:
            batch = decode_message(bytes(damaged), schema)
        except FileFormatError:
            refusals += 1
        else:  # what is taken can be used: every row is there and its numbers rise
            assert batch.pressure_raw.shape == batch.tile_flags.shape == (len(batch), 2)
            assert (np.diff(batch.seq) == 1).all()
            assert int(batch.pressure_raw.sum()) >= 0
    assert refusals > 400


@pytest.mark.parametrize("rows", [0, MAX_MESSAGE_FRAMES + 1])
def test_a_message_of_no_or_too_many_frames_is_refused(rows: int) -> None:
    refused(frames(rows, 1), f"a message of {rows} frames.*{MAX_MESSAGE_FRAMES}")


@pytest.mark.parametrize(
    ("seq", "match"),
    [
        *(((n, n + 1, n + 2), r"less than 2\^53") for n in (2**53, 2**53 - 2, 2**63 - 2)),
        *(
            (seq, "do not follow one another")
            for seq in ((0, 1, 3), (0, 0, 1), (2, 1, 0), (5, 6, 6))
        ),
        ((2**64 - 2, 2**64 - 1, 0), "do not follow one another|less than 2"),
    ],
)
def test_numbers_that_no_stream_has_are_refused(seq: tuple[int, ...], match: str) -> None:
    refused(replace(frames(3), seq=np.array(seq, dtype=np.uint64)), match)


# --- refused before memory is taken ---------------------------------------------------------------


def written(record: pa.RecordBatch, **options: Any) -> bytes:
    """The record's own message, as a stream writer with these options makes it."""
    sink = pa.BufferOutputStream()
    options = {"options": pa.ipc.IpcWriteOptions(**options)}
    with pa.ipc.new_stream(sink, record.schema, **options) as writer:
        writer.write_batch(record)
    stream = sink.getvalue()
    begin = len(record.schema.serialize())
    return stream.slice(begin, stream.size - begin - 8).to_pybytes()


def with_empty_value(record: pa.RecordBatch) -> bytes:
    at = record.schema.get_field_index("servo_counts")
    columns = [*record.columns]
    columns[at] = pa.array([None, *columns[at].to_pylist()[1:]], pa.int32())
    loose = pa.schema([field.with_nullable(True) for field in record.schema])
    return pa.RecordBatch.from_arrays(columns, schema=loose).serialize().to_pybytes()


MIDDLE = frames().slice_rows(20, 40)
RECORD = frames_to_record_batch(MIDDLE, SCHEMA)
WORDS = pa.RecordBatch.from_arrays([pa.array(["a", "b"]).dictionary_encode()], names=["seq"])
NO_MESSAGES = {
    "a schema": (SCHEMA.serialize().to_pybytes(), "no Arrow message of frames"),
    "an end": (b"\xff\xff\xff\xff\0\0\0\0", "no Arrow message of frames"),
    "a file": (b"PAR1" * 50, "no Arrow message of frames"),
    "nothing": (b"", "message"),
    "a byte": (b"\0", "message"),
    "a dictionary": (written(WORDS), "no Arrow message of frames"),
    "three tiles": (encode_frames(frames(20, 3, first=20), schema_of(3)), "columns are not those"),
    "one tile": (encode_frames(frames(20, 1, first=20), schema_of(1)), "columns are not those"),
    "zstd": (written(RECORD, compression="zstd"), "compressed"),
    # In a journal they would stand where the next message has to begin.
    "bytes behind": (encode_frames(MIDDLE, SCHEMA) + bytes(8), "not those its header states"),
    # Its columns lie four bytes before the places by which runs of messages are read.
    "legacy": (
        written(RECORD, use_legacy_format=True) + bytes(4),
        "does not begin as messages do",
    ),
    "an empty value": (with_empty_value(RECORD), "without empty values"),
}


@pytest.mark.parametrize("what", NO_MESSAGES)
def test_another_message_is_refused_alone_and_among_others(what: str) -> None:
    payload, says = NO_MESSAGES[what]
    before = pa.total_allocated_bytes()
    with pytest.raises(FileFormatError, match=says):
        decode_message(payload, SCHEMA)
    assert pa.total_allocated_bytes() - before < 1 << 20
    parts = cut(frames(), [20, 40])
    first, _, last = (encode_frames(part, SCHEMA) for part in parts)
    assert not is_read(parts, [first, payload, last])
    assert not is_read([])


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
def test_compressed_buffers_are_refused_before_they_are_unpacked(codec: str) -> None:
    record = frames_to_record_batch(frames(4096, 64), schema_of(64))
    payload, before = written(record, compression=codec), pa.total_allocated_bytes()
    with pytest.raises(FileFormatError, match="compressed"):
        decode_message(payload, schema_of(64))
    assert pa.total_allocated_bytes() - before < 1 << 20


@given(data=st.data())
def test_whatever_a_header_says_of_lengths_little_memory_is_taken(data: st.DataObject) -> None:
    """Any 64 bits of the header as any number: rows, nulls, offsets, lengths."""
    schema = schema_of(2)
    payload = bytearray(encode_frames(frames(5), schema))
    header_bytes = int.from_bytes(payload[4:8], "little")
    for _ in range(data.draw(st.integers(1, 3))):
        at = 8 + 8 * data.draw(st.integers(0, header_bytes // 8 - 1))
        number = data.draw(st.sampled_from([-1, 0, 1, 2**31, 2**40, 2**62, 2**63 - 1]))
        payload[at : at + 8] = number.to_bytes(8, "little", signed=True)
    before = pa.total_allocated_bytes()
    try:
        batch = decode_message(bytes(payload), schema)
    except FileFormatError:
        pass
    else:
        assert len(batch) == 5
    assert pa.total_allocated_bytes() - before < 1 << 20


@given(st.lists(st.integers(-(2**63), 2**63 - 1), min_size=2, max_size=6))
def test_time_that_runs_backwards_is_refused_however_far(times: list[int]) -> None:
    batch = replace(frames(len(times)), t_mono_ns=np.array(times, dtype=np.int64))
    if times == sorted(times):
        schema = schema_of(2)
        assert_same_bits(decode_message(encode_frames(batch, schema), schema), batch)
    else:
        refused(batch, "time runs backwards")


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


def read_run(run: MessageBatch) -> FrameBatch | None:
    return MessageBatchDecoder(SCHEMA).decode_or_none_if_damaged(run)


def is_read(batches: Sequence[FrameBatch], payloads: Sequence[bytes] | None = None) -> bool:
    return read_run(run_of(batches, payloads)) is not None


cuts = st.lists(st.integers(0, ROWS), max_size=8)


@settings(max_examples=50)
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
    whole = frames(sum(sizes))
    assert_same_bits(read_run(run_of(cut(whole, list(accumulate(sizes))))), whole)


@given(cuts=cuts, data=st.data())
def test_no_flipped_bit_is_read(cuts: list[int], data: st.DataObject) -> None:
    run = run_of(cut(frames(), cuts))
    damaged = bytearray(run.content)
    damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    assert read_run(replace(run, content=bytes(damaged))) is None


@given(behind=st.integers(-200, 200).filter(bool))
def test_bytes_that_are_too_few_or_too_many_are_not_read(behind: int) -> None:
    run = run_of(cut(frames(), [20, 40]))
    content = run.content + bytes(behind) if behind > 0 else run.content[:behind]
    assert read_run(replace(run, content=content)) is None


def test_an_index_that_says_other_numbers_than_the_messages_is_not_followed() -> None:
    run = run_of(cut(frames(), [20, 40]))
    wrong: list[dict[str, Any]] = [{"length": run.length + np.array([8, 0, -8])}]
    for seq in ([0, 20, 41], [0, 19, 40], [1, 20, 40], [2**63, 20, 40]):
        wrong.append({"seq_first": np.array(seq, "<u8")})
    for count in ([20, 20, 21], [20, 20, 19], [21, 19, 20], [20, 0, 40]):
        wrong.append({"count": np.array(count, "<u4")})
    assert read_run(run) is not None
    for changes in wrong:
        assert read_run(replace(run, **changes)) is None, changes


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

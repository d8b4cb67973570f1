"""Messages of frames: the same bits at the other end, and nothing else is taken for one."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.frames import FrameBatch
from storage.message_layout import MAX_MESSAGE_FRAMES
from storage.schema import frames_to_record_batch, wire_schema
from storage.wire import decode_message, encode_frames
from tests.builders.arrays import make_array
from tests.builders.frames import any_frames, assert_same_bits


def schema_of(tiles: int) -> pa.Schema:
    return wire_schema(make_array(tiles))


def frames(rows: int, tiles: int = 2, seed: int = 0, *, first: int = 0) -> FrameBatch:
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


@settings(deadline=None)
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


def test_messages_behind_the_schema_are_a_stream_that_arrow_reads_alone() -> None:
    schema, batch = schema_of(3), frames(20, 3)
    stream = schema.serialize().to_pybytes() + b"".join(
        encode_frames(batch.slice_rows(a, a + 5), schema) for a in range(0, 20, 5)
    )
    table = pa.ipc.open_stream(stream).read_all()
    assert table.column("seq").to_pylist() == list(range(20))
    assert table.column("pressure_raw").to_pylist() == batch.pressure_raw.tolist()


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


def test_a_message_that_is_no_batch_of_records_is_refused() -> None:
    schema = schema_of(2)
    for payload in (schema.serialize().to_pybytes(), b"\xff\xff\xff\xff\0\0\0\0", b"PAR1" * 50):
        with pytest.raises(FileFormatError, match="no Arrow message of frames"):
            decode_message(payload, schema)


@pytest.mark.parametrize(("sent", "known"), [(1, 2), (2, 1), (3, 4), (9, 2)])
def test_frames_of_another_number_of_tiles_are_refused(sent: int, known: int) -> None:
    payload = encode_frames(frames(20, sent), schema_of(sent))
    with pytest.raises(FileFormatError):
        decode_message(payload, schema_of(known))


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


def _written(record: pa.RecordBatch, options: pa.ipc.IpcWriteOptions) -> bytes:
    """The record's own message, as a stream writer with these options makes it."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, record.schema, options=options) as writer:
        writer.write_batch(record)
    stream = sink.getvalue()
    begin = len(record.schema.serialize())
    return stream.slice(begin, stream.size - begin - 8).to_pybytes()


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
def test_compressed_buffers_are_refused_before_they_are_unpacked(
    codec: Literal["zstd", "lz4"],
) -> None:
    schema, batch = schema_of(64), frames(4096, 64)
    options = pa.ipc.IpcWriteOptions(compression=codec)
    payload = _written(frames_to_record_batch(batch, schema), options)
    before = pa.total_allocated_bytes()
    with pytest.raises(FileFormatError, match="compressed"):
        decode_message(payload, schema)
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


def test_a_message_with_bytes_behind_it_is_refused() -> None:
    """In a journal they would stand where the next message has to begin."""
    schema = schema_of(2)
    with pytest.raises(FileFormatError, match="not those its header states"):
        decode_message(encode_frames(frames(5), schema) + bytes(8), schema)


def test_a_message_in_the_form_of_arrow_before_015_is_refused() -> None:
    """Its columns lie four bytes before the places by which runs of messages are read."""
    schema = schema_of(2)
    options = pa.ipc.IpcWriteOptions(use_legacy_format=True)
    payload = _written(frames_to_record_batch(frames(1), schema), options) + bytes(4)
    with pytest.raises(FileFormatError, match="does not begin as messages do"):
        decode_message(payload, schema)


def test_a_dictionary_is_refused() -> None:
    words = pa.array(["a", "b"]).dictionary_encode()
    record = pa.RecordBatch.from_arrays([words], names=["seq"])
    payload = _written(record, pa.ipc.IpcWriteOptions())
    with pytest.raises(FileFormatError, match="no Arrow message of frames"):
        decode_message(payload, schema_of(2))


def test_a_column_with_empty_values_is_refused() -> None:
    schema = schema_of(2)
    record = frames_to_record_batch(frames(5), schema)
    at = schema.get_field_index("servo_counts")
    columns = [*record.columns]
    columns[at] = pa.array([1, None, 3, 4, 5], pa.int32())
    loose = pa.schema([field.with_nullable(True) for field in schema])
    payload = pa.RecordBatch.from_arrays(columns, schema=loose).serialize().to_pybytes()
    with pytest.raises(FileFormatError, match="without empty values"):
        decode_message(payload, schema)


@given(st.lists(st.integers(-(2**63), 2**63 - 1), min_size=2, max_size=6))
def test_time_that_runs_backwards_is_refused_however_far(times: list[int]) -> None:
    batch = replace(frames(len(times)), t_mono_ns=np.array(times, dtype=np.int64))
    if times == sorted(times):
        schema = schema_of(2)
        assert_same_bits(decode_message(encode_frames(batch, schema), schema), batch)
    else:
        refused(batch, "time runs backwards")

"""The same frames in the formats that others use, each written by its own library, and read back.

h5py and hdf5plugin are the extra `bench`; without them HDF5 is not measured, which is said.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from recording_data import Recording, batches

from devices.frames import FrameBatch
from storage.formats.export import make_sealed_export
from storage.formats.slice import Slice
from storage.formats.writers.tables import ARROW
from storage.journal.journal import Journal
from storage.schema import MEASURED_COLUMNS, to_flat_columns, wire_schema
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import MIN_ROW_GROUP_NS, SealedFileWriter
from storage.wire import encode_frames

Values = npt.NDArray[Any]
Write = Callable[[Path, Recording], None]
Read = Callable[[Path, str, int, int], Values]

HDF5 = {"HDF5 gzip 4 + shuffle": "h5py", "HDF5 blosc2 zstd + bitshuffle": "hdf5plugin"}


def absent() -> list[str]:
    """A line for each format that cannot be measured here."""
    return [
        f"{name}: not measured, {package} is not installed."
        for name, package in HDF5.items()
        if find_spec("h5py") is None or find_spec(package) is None
    ]


def flat_table(frames: FrameBatch) -> pa.Table:
    """The flat columns of a sealed file, what is missing as null, minute by minute."""
    values = {column.name: getattr(frames, column.name) for column in MEASURED_COLUMNS}
    fields, arrays = zip(*to_flat_columns(MEASURED_COLUMNS, values), strict=True)
    return pa.Table.from_arrays(list(arrays), schema=pa.schema(list(fields)))


def minute(frames: FrameBatch) -> int:
    """Frames in a minute, which is what a row group, a chunk or a record batch holds here."""
    span_ns = int(frames.t_mono_ns[-1] - frames.t_mono_ns[0])
    return max(1, min(len(frames), round(len(frames) * MIN_ROW_GROUP_NS / max(1, span_ns))))


def write_parquet(path: Path, recording: Recording) -> None:
    with SealedFileWriter(path, recording.info, {}) as writer:
        writer.append_frames(recording.frames, {})


def write_parquet_default(path: Path, recording: Recording) -> None:
    pq.write_table(flat_table(recording.frames), path, row_group_size=minute(recording.frames))


def write_csv(path: Path, recording: Recording) -> None:
    pacsv.write_csv(flat_table(recording.frames), path)


def write_arrow(
    path: Path, recording: Recording, compression: Literal["zstd"] | None = None
) -> None:
    table = flat_table(recording.frames)
    options = pa.ipc.IpcWriteOptions(compression=compression)
    with pa.ipc.new_file(str(path), table.schema, options=options) as writer:
        writer.write_table(table, max_chunksize=minute(recording.frames))


def write_arrow_zstd(path: Path, recording: Recording) -> None:
    write_arrow(path, recording, "zstd")


def write_hdf5(path: Path, recording: Recording, blosc: bool = False) -> None:
    import h5py

    how: Mapping[str, Any] = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
    if blosc:
        import hdf5plugin

        how = dict(hdf5plugin.Blosc2(cname="zstd", clevel=5, filters=2))
    with h5py.File(path, "w") as file:
        for name, column in flat_arrays(recording.frames).items():
            file.create_dataset(name, data=column, chunks=(minute(recording.frames),), **how)


def write_hdf5_blosc(path: Path, recording: Recording) -> None:
    write_hdf5(path, recording, blosc=True)


def write_journal(path: Path, recording: Recording) -> None:
    schema = wire_schema(recording.info)
    journal = Journal(path, recording.info)
    for batch in batches(recording.frames):
        journal.append_new_frames(batch, encode_frames(batch, schema))
    journal.close()


def flat_arrays(frames: FrameBatch) -> dict[str, Values]:
    """The flat columns as plain numbers: HDF5 has no nulls."""
    arrays = {}
    for column in MEASURED_COLUMNS:
        values = getattr(frames, column.name)
        parts = values.T if column.per_tile else values[None]
        for name, part in zip(column.flat_names(len(parts)), parts, strict=True):
            arrays[name] = np.ascontiguousarray(part)
    return arrays


def writers() -> dict[str, Write]:
    """By format, those that can be written here."""
    every: dict[str, Write] = {
        "sealed Parquet": write_parquet,
        "Parquet, pyarrow's defaults": write_parquet_default,
        "CSV": write_csv,
        "HDF5 gzip 4 + shuffle": write_hdf5,
        "HDF5 blosc2 zstd + bitshuffle": write_hdf5_blosc,
        "Arrow file": write_arrow,
        "Arrow file, zstd": write_arrow_zstd,
        "journal": write_journal,
    }
    missing = {line.partition(":")[0] for line in absent()}
    return {name: write for name, write in every.items() if name not in missing}


def size_bytes(path: Path) -> int:
    """Of a file, or of all files in a folder."""
    if path.is_dir():
        return sum(each.stat().st_size for each in path.iterdir())
    return path.stat().st_size


# --- one column, from one instant to another ------------------------------------------------------


def read_parquet(path: Path, column: str, begin_ns: int, end_ns: int) -> Values:
    """The row groups that the statistics of `t_ns` name, and of them two columns."""
    pieces = []
    with pq.ParquetFile(path, page_checksum_verification=True) as file:
        at = file.schema_arrow.get_field_index("t_ns")
        for group in range(file.num_row_groups):
            known: Any = file.metadata.row_group(group).column(at).statistics
            if known.min < end_ns and known.max >= begin_ns:
                table = file.read_row_group(group, columns=["t_ns", column])
                pieces.append(_between(table, column, begin_ns, end_ns))
    return np.concatenate(pieces)


def read_as_service(path: Path, column: str, begin_ns: int, end_ns: int) -> Values:
    """What the server and `foottile export` do for a slice of a sealed session."""
    with SealedFileReader(path, only_slices=True) as reader:
        first_ns = _first_t_ns(path)
        part = Slice((begin_ns - first_ns) * 1e-9, (end_ns - first_ns) * 1e-9, (column,))
        content = b"".join(ARROW.encode(make_sealed_export(reader, part)))
    return pa.ipc.open_file(content).read_all().column(column).to_numpy()


def read_csv(path: Path, column: str, begin_ns: int, end_ns: int) -> Values:
    """From the top until the slice is over, two columns."""
    pieces = []
    wanted = pacsv.ConvertOptions(include_columns=["t_ns", column])
    with pacsv.open_csv(path, convert_options=wanted) as reader:
        for batch in reader:
            t_ns = batch.column("t_ns").to_numpy()
            if t_ns[-1] >= begin_ns:
                pieces.append(_between(pa.Table.from_batches([batch]), column, begin_ns, end_ns))
            if t_ns[-1] >= end_ns:
                break
    return np.concatenate(pieces)


def read_hdf5(path: Path, column: str, begin_ns: int, end_ns: int) -> Values:
    """`t_ns` is searched for both ends, then the rows between are read."""
    import h5py

    if find_spec("hdf5plugin") is not None:
        import hdf5plugin  # noqa: F401  # h5py finds its filters once it is imported
    with h5py.File(path, "r") as file:
        t_ns = file["t_ns"]
        begin, end = (_first_from(lambda i: int(t_ns[i]), len(t_ns), t) for t in (begin_ns, end_ns))
        return np.asarray(file[column][begin:end])


def read_arrow(path: Path, column: str, begin_ns: int, end_ns: int) -> Values:
    """The record batches are searched for the one in which the slice begins, in mapped memory."""
    with pa.memory_map(str(path)) as mapped:
        names = pa.ipc.open_file(mapped).schema.names
        fields = [names.index("t_ns"), names.index(column)]
        file = pa.ipc.open_file(mapped, options=pa.ipc.IpcReadOptions(included_fields=fields))

        def last_t_ns(number: int) -> int:
            return int(file.get_batch(number).column("t_ns")[-1].as_py())

        number = _first_from(last_t_ns, file.num_record_batches, begin_ns)
        pieces = []
        while number < file.num_record_batches:
            batch = file.get_batch(number)
            pieces.append(_between(pa.Table.from_batches([batch]), column, begin_ns, end_ns))
            if last_t_ns(number) >= end_ns:
                break
            number += 1
        return np.concatenate(pieces)


def readers() -> dict[str, tuple[str, Read]]:
    """By name: which file is read, and how."""
    every: dict[str, tuple[str, Read]] = {
        "sealed Parquet, its row group": ("sealed Parquet", read_parquet),
        "sealed Parquet, as server and `foottile export` do": ("sealed Parquet", read_as_service),
        "CSV": ("CSV", read_csv),
        "HDF5 gzip 4 + shuffle": ("HDF5 gzip 4 + shuffle", read_hdf5),
        "HDF5 blosc2 zstd + bitshuffle": ("HDF5 blosc2 zstd + bitshuffle", read_hdf5),
        "Arrow file, mapped": ("Arrow file", read_arrow),
        "Arrow file, zstd": ("Arrow file, zstd", read_arrow),
    }
    there = writers()
    return {name: found for name, found in every.items() if found[0] in there}


def _between(table: pa.Table, column: str, begin_ns: int, end_ns: int) -> Values:
    t_ns = table.column("t_ns").to_numpy()
    begin, end = np.searchsorted(t_ns, [begin_ns, end_ns])
    return table.column(column)[int(begin) : int(end)].to_numpy()


def _first_from(t_ns_of: Callable[[int], int], n: int, t_ns: int) -> int:
    """The first number of 0 to n whose time is not before `t_ns`."""
    low, high = 0, n
    while low < high:
        middle = (low + high) // 2
        if t_ns_of(middle) < t_ns:
            low = middle + 1
        else:
            high = middle
    return low


def _first_t_ns(path: Path) -> int:
    with pq.ParquetFile(path) as file:
        at = file.schema_arrow.get_field_index("t_ns")
        known: Any = file.metadata.row_group(0).column(at).statistics
        return int(known.min)

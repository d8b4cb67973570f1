"""Reader of a sealed session: complete, or the row groups and columns of a slice.

Data is verified before it is read: the whole file by its hash, or for slices the footer by its own,
and every page by its checksum. The statistics of a verified footer give the row groups that may
have frames of a time range.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError, UsageError
from devices.frames import FrameBatch
from storage.parquet_hash import FILE_HASH_KEY
from storage.schema import (
    COLUMNS_BY_NAME,
    MEASURED_COLUMNS,
    Array,
    map_flat_columns,
    read_flat_column_and_fill_nulls,
    read_quantity,
)
from storage.sessions.footer import FileStamps, SealedFileFooter, read_file_stamps_or_empty
from storage.sessions.metadata import load_clock_table, read_stream_ids
from storage.sessions.time_axis import (
    NODE_AXIS,
    TIME_AXIS_NOTE,
    PartSpan,
    TimeAxis,
    compute_time_axis,
)

_PIECE_VALUES = 1 << 20
_MIN_PIECE_ROWS = 1024
"""Fewest rows of a piece of a row group.

A piece otherwise has so many rows that it has `_PIECE_VALUES` numbers: 8 MiB, however many tiles.
"""


class SealedFileReader:
    """Reader of a sealed file, some thousand rows at a time.

    Attributes:
        path: the file.
        footer: its footer; `info`, `notes`, `content`, `content_sha256`, `column_names` and
            `frame_count` are those of `storage.sessions.footer.SealedFileFooter`.
    """

    def __init__(
        self,
        path: Path,
        *,
        skip_verification: bool = False,
        only_slices: bool = False,
        footer: SealedFileFooter | None = None,
    ) -> None:
        """Open a sealed session and verify it.

        The whole file is verified against its hash. If only slices are read, the footer alone is
        verified against its own hash; pages are always verified against their checksums.

        Args:
            path: the file.
            skip_verification: skip the hashes: the file was verified already, or shall not be.
            only_slices: only some columns or a time range will be read.
            footer: footer of this file, if it was read before.

        Raises:
            FileFormatError: no such file, not Parquet, not one of ours, or damaged.
        """
        self.path = path
        self.footer, self._file = _open_with_footer(path, footer, skip_verification, only_slices)
        self.info, self.notes = self.footer.info, self.footer.notes
        self.content, self.content_sha256 = self.footer.content, self.footer.content_sha256
        self.column_names = self.footer.column_names
        self.frame_count = self.footer.frame_count

    def read_tables(self) -> Iterator[pa.Table]:
        """Yield all columns as in the file, a piece of a row group at a time.

        Raises:
            FileFormatError: a row group is damaged.
        """
        for group in range(len(self.footer.rows_by_group)):
            yield from self._read_pieces(group, None)

    @property
    def session_id_and_hashes(self) -> dict[str, object]:
        """Source reference for derived files: session id, content hash, stated file hash."""
        metadata = self.footer.metadata.metadata or {}
        session = self.notes.get("session")
        return {
            "session": session.get("id") if isinstance(session, dict) else None,
            "content_sha256": self.content_sha256,
            "file_sha256": metadata.get(FILE_HASH_KEY, b"").decode("ascii", "replace") or None,
        }

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def has_columns(self, *quantity_names: str) -> bool:
        """Return whether the file has these quantities (of `storage.schema.COLUMNS_BY_NAME`)."""
        tiles = len(self.info.tiles)
        return all(
            self.column_names.issuperset(COLUMNS_BY_NAME[name].flat_names(tiles))
            for name in quantity_names
        )

    def read_batches(
        self, *extra_quantities: str, row_groups: Sequence[int] | None = None
    ) -> Iterator[tuple[FrameBatch, dict[str, Array]]]:
        """Yield frames in the order they were written, with extra columns.

        Args:
            extra_quantities: names of the extra columns.
            row_groups: row groups to read; None: all.

        Raises:
            FileFormatError: a column is missing, of another type, or damaged.
        """
        names = (*(column.name for column in MEASURED_COLUMNS), *extra_quantities)
        for values in self.read_quantities(*names, row_groups=row_groups):
            yield (
                FrameBatch(**{column.name: values.pop(column.name) for column in MEASURED_COLUMNS}),
                values,
            )

    def read_quantities(
        self,
        *quantity_names: str,
        row_groups: Sequence[int] | None = None,
        max_values: int | None = None,
    ) -> Iterator[dict[str, Array]]:
        """Yield some quantities (of `COLUMNS_BY_NAME`), some thousand rows at a time.

        Args:
            quantity_names: names of the quantities.
            row_groups: row groups to read; None: all.
            max_values: most numbers of a piece; None: the default.

        Raises:
            FileFormatError: as for `read_batches`.
        """
        tiles = len(self.info.tiles)
        names = [
            flat for name in quantity_names for flat in COLUMNS_BY_NAME[name].flat_names(tiles)
        ]
        for group in range(len(self.footer.rows_by_group)) if row_groups is None else row_groups:
            for table in self._read_pieces(group, names, max_values):
                with self._translate_damage(group):
                    values = {
                        name: read_quantity(COLUMNS_BY_NAME[name], table, tiles)
                        for name in quantity_names
                    }
                yield values

    @property
    def time_axis(self) -> TimeAxis:
        """Time axis of the session.

        Raises:
            FileFormatError: as for `read_batches`.
        """
        if self.footer.time_axis is None:
            self.footer.time_axis = self._compute_time_axis()
        return self.footer.time_axis

    def read_span_on_axis_ns(self) -> tuple[int, int]:
        """Return `t_ns` of the first and of the last frame, both on the session's time axis.

        Raises:
            FileFormatError: as for `read_batches`.
        """
        if self.footer.span_ns is not None:
            return self.footer.span_ns
        if self.time_axis.is_shifted:
            shifted = [
                [t_ns + self.time_axis.get_shift_ns(span.number) for t_ns in span.t_ns]
                for span in self.read_part_spans()
            ]
            self.footer.span_ns = shifted[0][0], max(last for _, last in shifted)
            return self.footer.span_ns
        first, *_ = self._read_pieces(0, ["t_ns"])  # all: their row count shows a skipped page
        with self._translate_damage(0):
            begin = int(read_flat_column_and_fill_nulls(COLUMNS_BY_NAME["t_ns"], "t_ns", first)[0])
        latest = self.read_min_max_by_row_group("t_ns")
        unknown_groups = [group for group, min_max in enumerate(latest) if min_max is None]
        ends = [
            int(piece["t_ns"].max())
            for piece in self.read_quantities("t_ns", row_groups=unknown_groups)
        ]
        end = max([*ends, *(min_max[1] for min_max in latest if min_max is not None)])
        self.footer.span_ns = begin, end
        return begin, end

    def read_overlapping_row_groups(
        self, names: Sequence[str], begin_on_axis_ns: int | None, end_on_axis_ns: int | None
    ) -> Iterator[dict[str, Array]]:
        """Yield flat columns of all rows of the row groups that may have frames of a time range.

        Without statistics in the footer, all row groups are read.

        Args:
            names: names of the columns, each n rows.
            begin_on_axis_ns: first instant on the time axis; None: from the beginning.
            end_on_axis_ns: instant behind the last; None: to the end.

        Yields:
            At least one piece, which may have no rows.

        Raises:
            FileFormatError: as for `read_batches`.
        """
        logical = map_flat_columns(len(self.info.tiles))
        is_empty = True
        for group in self.find_overlapping_row_groups(begin_on_axis_ns, end_on_axis_ns):
            for table in self._read_pieces(group, names):
                with self._translate_damage(group):
                    values = {
                        name: read_flat_column_and_fill_nulls(logical[name], name, table)
                        for name in names
                    }
                yield values
                is_empty = False
        if is_empty:
            table = self.footer.schema.empty_table()
            with self._translate_damage(0):
                yield {
                    name: read_flat_column_and_fill_nulls(logical[name], name, table)
                    for name in names
                }

    def find_overlapping_row_groups(
        self, begin_on_axis_ns: int | None, end_on_axis_ns: int | None
    ) -> list[int]:
        """Return the row groups that may have frames of a time range.

        Bounds as for `read_overlapping_row_groups`.
        """
        if begin_on_axis_ns is None and end_on_axis_ns is None:
            return list(range(len(self.footer.rows_by_group)))
        return [
            group
            for group, min_max in enumerate(self.read_min_max_by_row_group("t_ns"))
            if min_max is None
            or self.time_axis.may_overlap(*min_max, begin_on_axis_ns, end_on_axis_ns)
        ]

    def read_frames(self) -> FrameBatch:
        """Read all frames at once.

        Raises:
            FileFormatError: as for `read_batches`.
        """
        return FrameBatch.concatenate([frames for frames, _ in self.read_batches()])

    def read_min_max_by_row_group(self, name: str) -> list[tuple[int, int] | None]:
        """Return minimum and maximum of a column in every row group; None: not certain."""
        return self.footer.read_min_max_by_row_group(name)

    def _compute_time_axis(self) -> TimeAxis:
        if stated := self.notes.get(TIME_AXIS_NOTE):
            return TimeAxis.from_json_list(stated, where=str(self.path))
        try:
            ids = read_stream_ids(self)
        except FileFormatError:  # another program's notes
            return NODE_AXIS
        if len(set(ids)) < 2 or not self.has_columns("part"):
            return NODE_AXIS
        try:
            clock = load_clock_table(self)
        except (UsageError, FileFormatError):  # the frames are readable without a clock table
            clock = None
        period_ns = round(1e9 / self.info.nominal_rate_hz)
        return compute_time_axis(self.read_part_spans(), clock, period_ns=period_ns)

    def read_part_spans(self) -> list[PartSpan]:
        """Return first and last frame of every part with frames, by the footer where possible."""
        names, ids = ("part", "t_mono_ns", "t_ns"), read_stream_ids(self)
        found: dict[int, list[tuple[int, int]]] = {}
        unknown_groups: list[int] = []
        for group, min_max in enumerate(
            zip(*(self.read_min_max_by_row_group(name) for name in names), strict=True)
        ):
            part, t_mono_ns, t_ns = min_max
            if part is None or t_mono_ns is None or t_ns is None or part[0] != part[1]:
                unknown_groups.append(group)
            else:
                found.setdefault(part[0], []).extend(zip(t_mono_ns, t_ns, strict=True))
        for piece in self.read_quantities(*names, row_groups=unknown_groups):
            for number in np.unique(piece["part"]).tolist():
                here = piece["part"] == number
                ends = [[int(v.min()), int(v.max())] for v in (piece[n][here] for n in names[1:])]
                found.setdefault(number, []).extend(zip(*ends, strict=True))
        spans = []
        for number, instants in sorted(found.items()):
            (mono_first, first), (mono_last, last) = min(instants), max(instants)
            stream_id = ids[number] if number < len(ids) else ""
            spans.append(PartSpan(number, stream_id, (mono_first, mono_last), (first, last)))
        return spans

    def _read_pieces(
        self, group: int, names: Sequence[str] | None, values_max: int | None = None
    ) -> Iterator[pa.Table]:
        """Yield some or all columns of a row group in pieces."""
        width = len(self.column_names if names is None else names)
        size = max(_MIN_PIECE_ROWS, (values_max or _PIECE_VALUES) // max(1, width))
        left = self.footer.rows_by_group[group]
        with self._translate_damage(group):
            if absent := set(names or ()) - self.column_names:
                raise KeyError(f"no column {', '.join(sorted(absent))}")
            columns = None if names is None else list(names)
            pieces = self._file.iter_batches(size, row_groups=[group], columns=columns)
        while left:
            with self._translate_damage(group):
                piece = next(pieces, None)
                if piece is None or len(piece) > left:
                    raise ValueError(
                        f"it has other than its {self.footer.rows_by_group[group]} rows"
                    )
            left -= len(piece)
            yield pa.Table.from_batches([piece])

    @contextmanager
    def _translate_damage(self, group: int) -> Iterator[None]:
        try:
            yield
        except (KeyError, ValueError, OSError, pa.ArrowException) as error:
            raise FileFormatError(
                f"row group {group} cannot be read: {error}", where=str(self.path)
            ) from error


def _open_with_footer(
    path: Path, footer: SealedFileFooter | None, is_checked: bool, only_slices: bool
) -> tuple[SealedFileFooter, pq.ParquetFile]:
    """Open a file and its footer; retry if the file is replaced in between."""
    while True:
        stamps = read_file_stamps_or_empty(path)
        own = footer or SealedFileFooter(
            path, skip_verification=is_checked, only_slices=only_slices
        )
        if footer is not None and not (is_checked or only_slices):
            footer.verify_file_hash_once(path)
        try:
            file = pq.ParquetFile(path, metadata=own.metadata, page_checksum_verification=True)
        except Exception as error:  # gone meanwhile, or damaged
            raise FileFormatError(
                f"cannot be read as Parquet: {str(error).strip()}", where=str(path)
            ) from error
        if footer is not None or stamps == read_file_stamps_or_empty(path):
            return own, file
        file.close()


_MAX_ENTRIES = 1000
_MAX_FOOTER_BYTES = 4 << 20
"""Most bytes of cached footers as in their files; parsed they take about eleven times as much."""


class VerifiedFileCache:
    """Cache of verified files and parsed footers. Thread-safe.

    Each file is verified against its hash once, and its footer is parsed once. A file whose stamps
    have changed is verified again; page checksums are verified at every read. The footers used last
    are kept, up to a limit of their bytes.
    """

    def __init__(self) -> None:
        self._verified_stamps: dict[FileStamps, None] = {}
        self._footers: dict[FileStamps, SealedFileFooter] = {}
        self._lock = Lock()

    def open_reader(self, path: Path, *, only_slices: bool = False) -> SealedFileReader:
        """Open a sealed session; verify it if it is not in the cache.

        Args:
            path: the file.
            only_slices: as for `SealedFileReader`.

        Raises:
            FileFormatError: as for `SealedFileReader`.
        """
        stamps = read_file_stamps_or_empty(path)
        with self._lock:
            footer = self._footers.pop(stamps, None)
            if footer is not None:
                self._footers[stamps] = footer  # the newest again
            is_checked = stamps in self._verified_stamps
        reader = SealedFileReader(
            path, skip_verification=is_checked, only_slices=only_slices, footer=footer
        )
        if stamps and stamps == read_file_stamps_or_empty(path):  # not replaced meanwhile
            with self._lock:
                self._store(stamps, reader.footer)
        elif footer is not None:  # it may be another file's by now
            reader.close()
            return self.open_reader(path, only_slices=only_slices)
        return reader

    def _store(self, stamps: FileStamps, footer: SealedFileFooter) -> None:
        if footer.is_file_verified:
            while (
                len(self._verified_stamps) >= _MAX_ENTRIES and stamps not in self._verified_stamps
            ):
                del self._verified_stamps[next(iter(self._verified_stamps))]
            self._verified_stamps[stamps] = None
        self._footers[stamps] = footer
        size_bytes = sum(cached.size_bytes for cached in self._footers.values())
        while size_bytes > _MAX_FOOTER_BYTES or len(self._footers) > _MAX_ENTRIES:
            size_bytes -= self._footers.pop(next(iter(self._footers))).size_bytes

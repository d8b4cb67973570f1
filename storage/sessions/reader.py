"""Reader of a sealed session: all of it, or the row groups and columns of a slice.

Data is verified before it is read: the whole file by its hash, or for slices the footer by its own,
and every page by its checksum. The statistics of a verified footer give the row groups that may
have frames of a time range.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError, UsageError
from devices.frames import FrameBatch
from storage.file_hash import FILE_HASH_KEY, FORMAT
from storage.schema import FRAMES, KNOWN, Array, flat_of, flat_values, from_flat
from storage.sessions.beside import clock_beside, stream_ids
from storage.sessions.footer import Footer, stamps_of
from storage.sessions.time_axis import NODE_AXIS, TIME_AXIS_NOTE, PartSpan, TimeAxis, time_axis

_PIECE_VALUES = 1 << 20
_PIECE_ROWS_MIN = 1024
"""Fewest rows of a piece of a row group.

A piece otherwise has so many rows that it has `_PIECE_VALUES` numbers: 8 MiB, however many tiles.
"""


class SessionReader:
    """Reader of a sealed file, some thousand rows at a time.

    Attributes:
        path: the file.
        footer: its footer; `info`, `notes`, `format`, `content`, `content_sha256`, `column_names`
            and `frame_count` are those of `storage.sessions.footer.Footer`.
    """

    def __init__(
        self,
        path: Path,
        *,
        is_checked: bool = False,
        only_slices: bool = False,
        footer: Footer | None = None,
    ) -> None:
        """Open a sealed session and verify it.

        The whole file is verified against its hash. If only slices are read, the footer alone is
        verified against its own hash; pages are always verified against their checksums. A file of
        an older version, whose footer has no hash, is verified completely in any case.

        Args:
            path: the file.
            is_checked: skip the hashes: the file was verified already, or shall not be.
            only_slices: only some columns or a time range will be read.
            footer: footer of this file, if it was read before.

        Raises:
            FileFormatError: no such file, not Parquet, not one of ours, or damaged.
        """
        self.path = path
        self.footer, self._file = _opened(path, footer, is_checked, only_slices)
        self._has_true_statistics = self.footer.is_proven or self.footer.format == FORMAT
        self.info, self.notes = self.footer.info, self.footer.notes
        self.format = self.footer.format
        self.content, self.content_sha256 = self.footer.content, self.footer.content_sha256
        self.column_names = self.footer.column_names
        self.frame_count = self.footer.frame_count

    def tables(self) -> Iterator[pa.Table]:
        """Yield all columns as in the file, a piece of a row group at a time.

        Raises:
            FileFormatError: a row group is damaged.
        """
        for group in range(len(self.footer.group_rows)):
            yield from self._tables(group, None)

    @property
    def identity(self) -> dict[str, object]:
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

    def has(self, *names: str) -> bool:
        """Return whether the file has these quantities (of `storage.schema.KNOWN`)."""
        tiles = len(self.info.tiles)
        return all(self.column_names.issuperset(KNOWN[name].flat_names(tiles)) for name in names)

    def batches(
        self, *extra: str, groups: Sequence[int] | None = None
    ) -> Iterator[tuple[FrameBatch, dict[str, Array]]]:
        """Yield frames in the order they were written, with extra columns.

        Args:
            extra: names of the extra columns.
            groups: row groups to read; None: all.

        Raises:
            FileFormatError: a column is missing, of another type, or damaged.
        """
        names = (*(column.name for column in FRAMES), *extra)
        for values in self.columns(*names, groups=groups):
            yield FrameBatch(**{column.name: values.pop(column.name) for column in FRAMES}), values

    def columns(
        self,
        *wanted: str,
        groups: Sequence[int] | None = None,
        values_max: int | None = None,
    ) -> Iterator[dict[str, Array]]:
        """Yield some quantities (of `KNOWN`), some thousand rows at a time.

        Args:
            wanted: names of the quantities.
            groups: row groups to read; None: all.
            values_max: most numbers of a piece; None: the default.

        Raises:
            FileFormatError: as for `batches`.
        """
        tiles = len(self.info.tiles)
        names = [flat for name in wanted for flat in KNOWN[name].flat_names(tiles)]
        for group in range(len(self.footer.group_rows)) if groups is None else groups:
            for table in self._tables(group, names, values_max):
                with self._damage(group):
                    values = {name: from_flat(KNOWN[name], table, tiles) for name in wanted}
                yield values

    @property
    def axis(self) -> TimeAxis:
        """Time axis of the session.

        Raises:
            FileFormatError: as for `batches`.
        """
        if self.footer.axis is None:
            self.footer.axis = self._time_axis()
        return self.footer.axis

    def span_ns(self) -> tuple[int, int]:
        """Return `t_ns` of the first and of the last frame, both on the session's time axis.

        Raises:
            FileFormatError: as for `batches`.
        """
        if self.footer.span_ns is not None:
            return self.footer.span_ns
        if self.axis.is_shifted:
            shifted = [
                [t_ns + self.axis.shift_ns(span.number) for t_ns in span.t_ns]
                for span in self._part_spans()
            ]
            self.footer.span_ns = shifted[0][0], max(last for _, last in shifted)
            return self.footer.span_ns
        first, *_ = self._tables(0, ["t_ns"])  # all: their row count shows a skipped page
        with self._damage(0):
            begin = int(flat_values(KNOWN["t_ns"], "t_ns", first)[0])
        latest = self.extremes("t_ns")
        unknown_groups = [group for group, min_max in enumerate(latest) if min_max is None]
        ends = [int(piece["t_ns"].max()) for piece in self.columns("t_ns", groups=unknown_groups)]
        end = max([*ends, *(min_max[1] for min_max in latest if min_max is not None)])
        self.footer.span_ns = begin, end
        return begin, end

    def flat(
        self, names: Sequence[str], begin_t_ns: int | None, end_t_ns: int | None
    ) -> Iterator[dict[str, Array]]:
        """Yield flat columns of the row groups that may have frames of a time range.

        Without a verified footer, or without its statistics, all row groups are read.

        Args:
            names: names of the columns, each n rows.
            begin_t_ns: first instant on the time axis; None: from the beginning.
            end_t_ns: instant behind the last; None: to the end.

        Yields:
            At least one piece, which may have no rows.

        Raises:
            FileFormatError: as for `batches`.
        """
        logical = flat_of(len(self.info.tiles))
        is_empty = True
        for group in self.groups_within(begin_t_ns, end_t_ns):
            for table in self._tables(group, names):
                with self._damage(group):
                    values = {name: flat_values(logical[name], name, table) for name in names}
                yield values
                is_empty = False
        if is_empty:
            table = self.footer.schema.empty_table()
            with self._damage(0):
                yield {name: flat_values(logical[name], name, table) for name in names}

    def groups_within(self, begin_t_ns: int | None, end_t_ns: int | None) -> list[int]:
        """Return the row groups that may have frames of a time range.

        Bounds as for `flat`.
        """
        if begin_t_ns is None and end_t_ns is None:
            return list(range(len(self.footer.group_rows)))
        return [
            group
            for group, min_max in enumerate(self.extremes("t_ns"))
            if min_max is None or self.axis.may_overlap(*min_max, begin_t_ns, end_t_ns)
        ]

    def frames(self) -> FrameBatch:
        """Read all frames at once.

        Raises:
            FileFormatError: as for `batches`.
        """
        return FrameBatch.concatenate([frames for frames, _ in self.batches()])

    def extremes(self, name: str) -> list[tuple[int, int] | None]:
        """Return minimum and maximum of a column in every row group; None: not certain."""
        if self._has_true_statistics:
            return self.footer.extremes(name)
        return [None] * len(self.footer.group_rows)  # an older version wrote no proof

    def _time_axis(self) -> TimeAxis:
        if stated := self.notes.get(TIME_AXIS_NOTE):
            return TimeAxis.from_dicts(stated, where=str(self.path))
        try:
            ids = stream_ids(self)
        except FileFormatError:  # another program's notes
            return NODE_AXIS
        if len(set(ids)) < 2 or not self.has("part"):
            return NODE_AXIS
        try:
            clock = clock_beside(self)
        except (UsageError, FileFormatError):  # the frames are readable without a clock table
            clock = None
        period_ns = round(1e9 / self.info.nominal_rate_hz)
        return time_axis(self._part_spans(), clock, period_ns=period_ns)

    def _part_spans(self) -> list[PartSpan]:
        """Return first and last frame of every part with frames, by the footer where possible."""
        names, ids = ("part", "t_mono_ns", "t_ns"), stream_ids(self)
        found: dict[int, list[tuple[int, int]]] = {}
        unknown_groups: list[int] = []
        for group, min_max in enumerate(zip(*(self.extremes(name) for name in names), strict=True)):
            part, t_mono_ns, t_ns = min_max
            if part is None or t_mono_ns is None or t_ns is None or part[0] != part[1]:
                unknown_groups.append(group)
            else:
                found.setdefault(part[0], []).extend(zip(t_mono_ns, t_ns, strict=True))
        for piece in self.columns(*names, groups=unknown_groups):
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

    def _tables(
        self, group: int, names: Sequence[str] | None, values_max: int | None = None
    ) -> Iterator[pa.Table]:
        """Yield some or all columns of a row group in pieces."""
        width = len(self.column_names if names is None else names)
        size = max(_PIECE_ROWS_MIN, (values_max or _PIECE_VALUES) // max(1, width))
        left = self.footer.group_rows[group]
        with self._damage(group):
            if absent := set(names or ()) - self.column_names:
                raise KeyError(f"no column {', '.join(sorted(absent))}")
            columns = None if names is None else list(names)
            pieces = self._file.iter_batches(size, row_groups=[group], columns=columns)
        while left:
            with self._damage(group):
                piece = next(pieces, None)
                if piece is None or len(piece) > left:
                    raise ValueError(f"it has other than its {self.footer.group_rows[group]} rows")
            left -= len(piece)
            yield pa.Table.from_batches([piece])

    @contextmanager
    def _damage(self, group: int) -> Iterator[None]:
        try:
            yield
        except (KeyError, ValueError, OSError, pa.ArrowException) as error:
            raise FileFormatError(
                f"row group {group} cannot be read: {error}", where=str(self.path)
            ) from error


def _opened(
    path: Path, footer: Footer | None, is_checked: bool, only_slices: bool
) -> tuple[Footer, pq.ParquetFile]:
    """Open a file and its footer; retry if the file is replaced in between."""
    while True:
        stamps = stamps_of(path)
        own = footer or Footer(path, is_checked=is_checked, only_slices=only_slices)
        if footer is not None and not is_checked:
            footer.prove(path, only_slices=only_slices)
        try:
            file = pq.ParquetFile(path, metadata=own.metadata, page_checksum_verification=True)
        except Exception as error:  # gone meanwhile, or damaged
            raise FileFormatError(f"cannot be read as Parquet: {error}", where=str(path)) from error
        if footer is not None or stamps == stamps_of(path):
            return own, file
        file.close()

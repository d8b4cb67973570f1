"""Stored comparisons of a session: a folder for each reference, beside the session's frames.

`compare.json` has the figures, `compare.md` and `compare.png` are for people, and `series.parquet`
has the compared frames. A folder's name is that of its reference, so it is looked up in the listing
and never made into a path.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from devices.errors import DamagedFileError, StorageError, UnknownError
from storage.documents import read_checksummed_json
from storage.durable_files import open_regular_file
from storage.parquet_hash import read_hashed_table, write_hashed_table
from storage.schema import Column

COMPARISONS_FOLDER = "comparisons"
"""Folder in a session's folder with a subfolder for each reference."""
REPORT_NAME = "compare.json"
SERIES_NAME = "series.parquet"

_F32 = pa.float32()
_GROUP_ROWS = 1 << 16
"""Rows of a row group: two minutes."""
MAX_SERIES_ROWS = 2_500_000
"""Most rows of a series: a longer one would not be read at once (`MAX_READ_BYTES`)."""

SERIES_COLUMNS = (
    Column("t_ns", pa.int64(), "ns", "of our frame, on the session's time axis"),
    Column("grf_n", _F32, "N", "ours"),
    Column("reference_grf_n", _F32, "N", "of the reference at our frame; less its zero if asked"),
    Column("reference_cop_x_m", _F32, "m", "of the reference where it bears load, forward"),
    Column("reference_cop_y_m", _F32, "m", "likewise, to the left"),
)
"""Columns of a series: our frames with a reference value, in the order of time."""

SERIES_SCHEMA = pa.schema(
    [
        column.make_field(column.name, column.type, nullable=column.type == _F32)
        for column in SERIES_COLUMNS
    ]
)


def find_comparison_folders(session_folder: Path) -> dict[str, Path]:
    """List a session's comparison folders by the reference's name, sorted.

    Args:
        session_folder: folder of the session.

    Raises:
        StorageError: it cannot be read now.
    """
    try:
        found = sorted((session_folder / COMPARISONS_FOLDER).iterdir())
        # A link may lead out of the session's folder.
        return {path.name: path for path in found if path.is_dir() and not path.is_symlink()}
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except OSError as error:
        raise StorageError(
            f"cannot be read: {error.strerror}",
            where=str(session_folder / COMPARISONS_FOLDER),
            errno=error.errno,
        ) from error


def find_comparison_folder(session_folder: Path, name: str) -> Path:
    """Find the folder of one comparison.

    Raises:
        UnknownError: there is none of this name.
        StorageError: it cannot be read now.
    """
    found = find_comparison_folders(session_folder)
    if name not in found:
        raise UnknownError(
            f"the session was not compared with {name!r}",
            expected=", ".join(found) or "a comparison: it has none",
            remedy="Make one with `foottile compare`",
        )
    return found[name]


def read_comparison_report(folder: Path) -> dict[str, Any]:
    """Read the report of a comparison, by name (docs/compare.md), and verify its checksum.

    Raises:
        DamagedFileError: `compare.json` is missing, or was changed.
        StorageError: it cannot be read now.
    """
    path = folder / REPORT_NAME
    try:
        text = read_checksummed_json(path)
    except FileNotFoundError as error:
        raise DamagedFileError("the comparison has no report", where=str(path)) from error
    content = json.loads(text)
    wanted = {"reference": str, "session": dict, "figures": dict, "alignment": dict, "notes": list}
    if not isinstance(content, dict) or not all(
        isinstance(content.get(name), kind) for name, kind in wanted.items()
    ):
        raise DamagedFileError(
            "is no report of a comparison",
            where=str(path),
            expected=", ".join(wanted),
            remedy="Compare again",
        )
    return content


def write_comparison_series(path: Path, table: pa.Table) -> None:
    """Write the compared frames, `series.parquet`; an existing one is replaced.

    Args:
        path: the file.
        table: of `SERIES_SCHEMA`.

    Raises:
        StorageError: the disk is full or not writable.
    """
    write_hashed_table(path, table, max_group_rows=_GROUP_ROWS)


def read_comparison_series(folder: Path) -> pa.Table | None:
    """Read the compared frames; None without a file: there were too many for a series.

    Raises:
        DamagedFileError: it was changed, or is no series.
        StorageError: it cannot be read now.
    """
    path = folder / SERIES_NAME
    try:
        table = read_hashed_table(path)
    except FileNotFoundError:
        return None
    if not table.schema.remove_metadata().equals(SERIES_SCHEMA):
        raise DamagedFileError(
            "is no series of a comparison",
            where=str(path),
            expected="columns " + ", ".join(SERIES_SCHEMA.names),
            remedy="Compare again",
        )
    return table


def read_comparison_series_footer_unverified(folder: Path) -> pq.FileMetaData:
    """Read the footer of a series that `read_comparison_series` has verified just now.

    Raises:
        DamagedFileError: it cannot be read as Parquet any more.
        StorageError: it cannot be read now.
    """
    with (
        open_regular_file(folder / SERIES_NAME) as content,
        _translate_damage(folder / SERIES_NAME),
    ):
        return pq.read_metadata(content)


def read_comparison_series_range(
    folder: Path, footer: pq.FileMetaData, begin_ns: int | None, end_ns: int | None
) -> pa.Table:
    """Read a time range of a series: only its row groups, with their page checksums.

    Args:
        folder: folder of the comparison.
        footer: footer of this file.
        begin_ns: first instant; None: from the beginning.
        end_ns: instant behind the last; None: to the end.

    Raises:
        DamagedFileError: a page's checksum is wrong.
        StorageError: it cannot be read now.
    """
    where = pc.scalar(True)
    if begin_ns is not None:
        where &= pc.field("t_ns") >= begin_ns
    if end_ns is not None:
        where &= pc.field("t_ns") < end_ns
    with (
        open_regular_file(folder / SERIES_NAME) as content,
        _translate_damage(folder / SERIES_NAME),
    ):
        options: dict[str, Any] = {"metadata": footer, "page_checksum_verification": True}
        with pq.ParquetFile(content, **options) as file:
            groups = _find_row_groups(footer, begin_ns, end_ns)
            return file.read_row_groups(groups, use_threads=False).filter(where)


def _find_row_groups(
    footer: pq.FileMetaData, begin_ns: int | None, end_ns: int | None
) -> list[int]:
    found = []
    for group in range(footer.num_row_groups):
        statistics: Any = footer.row_group(group).column(0).statistics
        is_after = begin_ns is None or statistics.max >= begin_ns
        if is_after and (end_ns is None or statistics.min < end_ns):
            found.append(group)
    return found


@contextmanager
def _translate_damage(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # damaged bytes may cause any error
        raise DamagedFileError(
            f"cannot be read: {' '.join(str(error).split())[:300]}", where=str(path)
        ) from error

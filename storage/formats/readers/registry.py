"""Registry of all table formats; a new format is a reader, its form, and a line here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import pyarrow as pa

from devices.errors import FileFormatError, FootTileError, UsageError
from storage.formats.readers import c3d, insoles, parquet, plate_texts, pressure_plate, rosbag, text
from storage.formats.readers.table import VALUES_MAX, ColumnFilter, ForceTable
from storage.formats.readers.text import TextOptions


@dataclass(frozen=True)
class TextFormat:
    """Text format of a measuring program, recognised by its head and not by the file's ending.

    Attributes:
        matches_head: predicate of the first `HEAD_CHARACTERS` of a text.
        read: function (text, column filter, limit of numbers) that returns the table; it may have
            columns that are not needed.
        form: expected form of the text, for errors.
    """

    matches_head: Callable[[str], bool]
    read: Callable[[str, ColumnFilter, int], ForceTable]
    form: str


TEXT_FORMATS = (
    TextFormat(insoles.is_loadsol, insoles.parse_loadsol_forces, insoles.LOADSOL_FORM),
    TextFormat(
        plate_texts.is_bioware, plate_texts.parse_bioware_force_and_cop, plate_texts.BIOWARE_FORM
    ),
    TextFormat(plate_texts.is_nexus, plate_texts.parse_nexus_force_and_cop, plate_texts.NEXUS_FORM),
    TextFormat(insoles.is_opengo, insoles.parse_opengo_force_and_cop, insoles.OPENGO_FORM),
    TextFormat(
        pressure_plate.is_tekscan,
        pressure_plate.parse_tekscan_force_and_cop,
        pressure_plate.TEKSCAN_FORM,
    ),
    TextFormat(insoles.is_pedar, insoles.refuse_pedar, ""),
    # Last: the format has no head.
    TextFormat(
        plate_texts.is_netforce, plate_texts.parse_netforce_force_and_cop_without_time, text.FORM
    ),
)


@dataclass(frozen=True)
class TableFormat:
    """Table format.

    Attributes:
        endings: endings of its files, in lower case.
        read: function (path, column filter, limit of numbers) that returns the table; it may
            have columns that are not needed.
        form: expected form of a file, for errors.
    """

    endings: tuple[str, ...]
    read: Callable[[Path, ColumnFilter, int], ForceTable]
    form: str


def _read_text(
    path: Path, is_needed: ColumnFilter, values_max: int, options: TextOptions | None = None
) -> ForceTable:
    options = options or TextOptions()
    remedy = "" if options.encoding else text.ENCODING_REMEDY
    content = text.read_decoded_text(path, options.encoding, no_text_remedy=remedy)
    head = content[: text.HEAD_CHARACTERS]
    for one in () if options.has_layout_option else TEXT_FORMATS:
        if one.matches_head(head):
            with _complete_errors(path, one.form):
                return one.read(content, is_needed, values_max)
    return text.parse_text_table(content, is_needed, values_max, options)


TEXT = TableFormat((".csv", ".txt", ".tsv"), _read_text, text.FORM)
BAG = TableFormat((".bag", ".mcap", ".db3"), rosbag.read_bag_wrenches, rosbag.FORM)
TABLE_FORMATS = (
    TEXT,
    BAG,
    TableFormat((".parquet",), parquet.read_parquet_table, "a Parquet file"),
    TableFormat((".c3d",), c3d.read_c3d_force_platforms, c3d.FORM),
    TableFormat((".mot", ".sto"), plate_texts.read_opensim_table, plate_texts.OPENSIM_FORM),
    TableFormat((".npz",), pressure_plate.read_npz_pressure_plate, pressure_plate.NPZ_FORM),
)


@contextmanager
def _complete_errors(path: Path, form: str) -> Iterator[None]:
    """Context manager: add the path and the expected form to errors that do not state them."""
    try:
        yield
    except FileFormatError as error:
        error.where = error.where or str(path)
        error.expected = error.expected or form
        raise
    except FootTileError:
        raise
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise FileFormatError(f"cannot be read: {error}", where=str(path), expected=form) from error
    except MemoryError as error:
        raise FileFormatError(
            ": ".join(filter(None, ("there is not enough memory to read it", str(error)))),
            where=str(path),
            expected="a file that fits in memory",
            remedy="Lift the limit (ulimit -v), or cut out the part that is needed",
        ) from error


def read_table(
    path: Path,
    is_needed: ColumnFilter,
    values_max: int = VALUES_MAX,
    text_options: TextOptions | None = None,
) -> ForceTable:
    """Read the needed columns of a file; the format follows from the ending, default text.

    Raises:
        FileFormatError: the file cannot be read.
        UsageError: a text layout is stated, and the file is no text.
    """
    ending = path.suffix.lower()
    chosen = next((one for one in TABLE_FORMATS if ending in one.endings), TEXT)
    if rosbag.is_bag_folder(path) or rosbag.is_cut_off_bag1(path):
        chosen = BAG
    with _complete_errors(path, chosen.form):
        if chosen is TEXT:
            table = _read_text(path, is_needed, values_max, text_options)
        else:
            refuse_any_text_options(path, text_options)
            table = chosen.read(path, is_needed, values_max)
    columns = {name: column for name, column in table.columns.items() if is_needed(name)}
    return replace(table, columns=columns, where=str(path))


def refuse_any_text_options(path: Path, text_options: TextOptions | None) -> None:
    """Refuse text options for a file that is no text.

    Raises:
        UsageError: an option is set.
    """
    if text_options is not None and text_options != TextOptions():
        raise UsageError(
            "--skip-rows, --units-row, --decimal and --encoding apply only to text tables",
            where=str(path),
            remedy="Leave them out",
        )

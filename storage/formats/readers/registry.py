"""Registry of all table formats; a new format is a module and a line here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from devices.errors import FileFormatError, UsageError
from storage.formats.readers.bioware import is_bioware, parse_bioware_force_and_cop
from storage.formats.readers.force_platform import read_c3d_force_platforms
from storage.formats.readers.moticon import is_moticon, parse_moticon_force_and_cop
from storage.formats.readers.netforce import is_netforce, parse_netforce_force_and_cop_without_time
from storage.formats.readers.nexus import is_nexus, parse_nexus_force_and_cop
from storage.formats.readers.novel import is_loadsol, is_pedar, parse_loadsol_forces, refuse_pedar
from storage.formats.readers.opensim import read_opensim_table
from storage.formats.readers.parquet import read_parquet_table
from storage.formats.readers.pressure_plate import (
    is_tekscan,
    parse_tekscan_force_and_cop,
    read_npz_pressure_plate,
)
from storage.formats.readers.rosbag import is_bag_folder, read_bag_wrenches
from storage.formats.readers.table import VALUES_MAX, ColumnFilter, ForceTable
from storage.formats.readers.text import HEAD_CHARACTERS, parse_text_table, read_decoded_text
from storage.formats.readers.text_options import TextOptions


@dataclass(frozen=True)
class TextFormat:
    """Text format of a measuring program, recognised by its head and not by the file's ending.

    Attributes:
        matches_head: predicate of the first `HEAD_CHARACTERS` of a text.
        read: function (text, path, limit of numbers) that returns the table, all its columns.
    """

    matches_head: Callable[[str], bool]
    read: Callable[[str, str, int], ForceTable]


TEXT_FORMATS: tuple[TextFormat, ...] = (
    TextFormat(is_bioware, parse_bioware_force_and_cop),
    TextFormat(is_nexus, parse_nexus_force_and_cop),
    TextFormat(is_moticon, parse_moticon_force_and_cop),
    TextFormat(is_tekscan, parse_tekscan_force_and_cop),
    TextFormat(is_pedar, refuse_pedar),
    TextFormat(
        is_netforce, parse_netforce_force_and_cop_without_time
    ),  # last: the format has no head
)


@dataclass(frozen=True)
class TableFormat:
    """Table format.

    Attributes:
        endings: endings of its files, in lower case.
        read: function (path, column filter, limit of numbers) that returns the table; it may
            have columns that are not needed.
    """

    endings: tuple[str, ...]
    read: Callable[[Path, ColumnFilter, int], ForceTable]


def _read_text(
    path: Path, is_needed: ColumnFilter, values_max: int, options: TextOptions | None = None
) -> ForceTable:
    options = options or TextOptions()
    text = read_decoded_text(path, options.encoding)
    head = text[:HEAD_CHARACTERS]
    where = str(path)
    if not options.has_layout_option:
        if is_loadsol(head):  # each sole has times of its own, which must agree if both are needed
            return parse_loadsol_forces(text, where, is_needed, values_max)
        for one in TEXT_FORMATS:
            if one.matches_head(head):
                return one.read(text, where, values_max)
    return parse_text_table(text, where, is_needed, values_max, options)


TEXT = TableFormat((".csv", ".txt", ".tsv"), _read_text)
BAG = TableFormat((".bag", ".mcap", ".db3"), read_bag_wrenches)
TABLE_FORMATS = (
    TEXT,
    BAG,
    TableFormat((".parquet",), read_parquet_table),
    TableFormat((".c3d",), lambda path, _, limit: read_c3d_force_platforms(path, limit)),
    TableFormat((".mot", ".sto"), read_opensim_table),
    TableFormat((".npz",), lambda path, _, limit: read_npz_pressure_plate(path, limit)),
)


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
    if is_bag_folder(path):
        chosen = BAG
    try:
        if chosen is TEXT:
            table = _read_text(path, is_needed, values_max, text_options)
        else:
            refuse_any_text_options(path, text_options)
            table = chosen.read(path, is_needed, values_max)
    except MemoryError as error:
        raise FileFormatError(
            "there is not enough memory to read it",
            where=str(path),
            remedy="Lift the limit (ulimit -v), or cut out the part that is needed",
        ) from error
    columns = {name: column for name, column in table.columns.items() if is_needed(name)}
    return replace(table, columns=columns)


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

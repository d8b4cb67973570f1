"""Registry of all table formats; a new format is a module and a line here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from devices.errors import FileFormatError, UsageError
from storage.formats.tables.bioware import is_bioware, read_bioware
from storage.formats.tables.force_platform import read_force_platforms
from storage.formats.tables.loadsol import is_loadsol, read_loadsol
from storage.formats.tables.moticon import is_moticon, read_moticon
from storage.formats.tables.netforce import is_netforce, read_netforce
from storage.formats.tables.nexus import is_nexus, read_nexus
from storage.formats.tables.opensim import read_opensim
from storage.formats.tables.parquet import read_parquet
from storage.formats.tables.pedar import is_pedar, refuse_pedar
from storage.formats.tables.pressure_plate import read_pressure_plate
from storage.formats.tables.rosbag import is_bag_folder, read_bag
from storage.formats.tables.stated_text import StatedText
from storage.formats.tables.table import NUMBERS_MAX, IsNeeded, Table
from storage.formats.tables.tekscan import is_tekscan, read_tekscan
from storage.formats.tables.text import HEAD_CHARACTERS, read_table_text, read_text_table


@dataclass(frozen=True)
class SavedText:
    """Text format of a measuring program, recognised by its head and not by the file's ending.

    Attributes:
        is_one: predicate of the first `HEAD_CHARACTERS` of a text.
        read: function (text, path, column filter, limit of numbers) that returns the table.
    """

    is_one: Callable[[str], bool]
    read: Callable[[str, str, IsNeeded, int], Table]


SAVED_TEXTS: tuple[SavedText, ...] = (
    SavedText(is_bioware, read_bioware),
    SavedText(is_nexus, read_nexus),
    SavedText(is_loadsol, read_loadsol),
    SavedText(is_moticon, read_moticon),
    SavedText(is_tekscan, read_tekscan),
    SavedText(is_pedar, refuse_pedar),
    SavedText(is_netforce, read_netforce),  # last: the format has no head
)


@dataclass(frozen=True)
class TableFormat:
    """Table format.

    Attributes:
        endings: endings of its files, in lower case.
        read: function (path, column filter, limit of numbers) that returns the table.
    """

    endings: tuple[str, ...]
    read: Callable[[Path, IsNeeded, int], Table]


def _read_text(
    path: Path, is_needed: IsNeeded, numbers_max: int, stated: StatedText | None = None
) -> Table:
    stated = stated or StatedText()
    text = read_table_text(path, stated.encoding)
    head = text[:HEAD_CHARACTERS]
    for one in () if stated.is_plain else SAVED_TEXTS:
        if one.is_one(head):
            return one.read(text, str(path), is_needed, numbers_max)
    return read_text_table(text, str(path), is_needed, numbers_max, stated)


TEXT = TableFormat((".csv", ".txt", ".tsv"), _read_text)
BAG = TableFormat((".bag", ".mcap", ".db3"), read_bag)
FORMATS = (
    TEXT,
    BAG,
    TableFormat((".parquet",), read_parquet),
    TableFormat((".c3d",), read_force_platforms),
    TableFormat((".mot", ".sto"), read_opensim),
    TableFormat((".npz",), read_pressure_plate),
)


def read_table(
    path: Path,
    is_needed: IsNeeded,
    numbers_max: int = NUMBERS_MAX,
    stated: StatedText | None = None,
) -> Table:
    """Read the needed columns of a file; the format follows from the ending, default text.

    Raises:
        FileFormatError: the file cannot be read.
        UsageError: a text layout is stated, and the file is no text.
    """
    ending = path.suffix.lower()
    chosen = next((one for one in FORMATS if ending in one.endings), TEXT)
    if is_bag_folder(path):
        chosen = BAG
    try:
        if chosen is TEXT:
            return _read_text(path, is_needed, numbers_max, stated)
        check_nothing_stated(path, stated)
        return chosen.read(path, is_needed, numbers_max)
    except MemoryError as error:
        raise FileFormatError(
            "there is not enough memory to read it",
            where=str(path),
            remedy="Lift the limit (ulimit -v), or cut out the part that is needed",
        ) from error


def check_nothing_stated(path: Path, stated: StatedText | None) -> None:
    """Refuse text options for a file that is no text.

    Raises:
        UsageError: an option is set.
    """
    if stated is not None and stated != StatedText():
        raise UsageError(
            "--skip-rows, --units-row, --decimal and --encoding apply only to text tables",
            where=str(path),
            remedy="Leave them out",
        )

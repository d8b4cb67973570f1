"""Reader of text files of columns from measuring programs and spreadsheets.

A line of names precedes the numbers. Blank lines, comments, a title or Excel's `sep=` may precede
it; a line of units may follow it. Commas, semicolons, tabs or blanks separate cells. Numbers have a
decimal point or a decimal comma. The text is UTF-8, UTF-16, or else Windows-1252. If detection
fails, the user states the layout (`TextOptions`). Columns without names are numbered: `column1`,
`column2` and so on.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv

from devices.arrays import Floats
from devices.errors import FileFormatError, UsageError
from devices.input_files import decode_text, read_bytes
from storage.formats.readers.table import (
    INSTANT_COLUMN,
    TEXT_BYTES_MAX,
    Column,
    ColumnFilter,
    ForceTable,
    check_table_size,
    make_table_with_lowercase_standard_names,
    select_needed_names_or_empty,
)

FORM = (
    "a text with a line of names above lines of numbers, parted by commas, semicolons or tabs; or "
    "a file that ends in .parquet, .c3d, .mot, .sto, .npz, .bag, .mcap or .db3"
)
HEAD_LINES = 200
"""Number of lines in which the line of names is searched."""
HEAD_CHARACTERS = 1 << 20
COMMENT_START = re.compile(r"^\s*(#|%|//)+\s*")
"""Beginning of a comment line."""
BLANKS = " "
"""Delimiter of columns that any number of blanks separates."""
DELIMITERS = ("\t", ";", ",", BLANKS)
KNOWN_UNITS = frozenset(
    (
        *("s", "sec", "ms", "us", "µs", "ns", "hz"),
        *("n", "kn", "mn", "kg", "g", "v", "mv"),
        *("m", "cm", "mm", "nm", "nmm", "n.m", "n.mm", "n*m", "n*mm", "n·m", "n·mm"),
        *("deg", "rad", "°", "pa", "kpa", "psi", "%"),
    )
)
MISSING_VALUE_PATTERN = (
    r"(?i)^[+-]?nan(\((ind|snan)\))?\d*$|^[+-]?1\.?#(ind|qnan|snan)0*$|^#?n/?a!?$|^null$|^none$|^$"
)
"""Pattern of cells without a number: empty, or NaN as Windows, C, Python and R write it."""
_NUMBER_PATTERN = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?|[+-]?inf", re.IGNORECASE)
_UNIT_IN_BRACKETS = re.compile(r"[\[(]\s*([^\[\]()\s]+)\s*[\])]$")
_AMBIGUOUS_COMMA = r"^[+-]?[1-9]\d{0,2},\d{3}$"
"""Pattern of ambiguous cells: decimal comma, or comma between thousands."""
DECIMAL_REMEDY = "State the mark of decimals: --decimal , or --decimal ."
ENCODING_REMEDY = "If it is one, state its encoding: --encoding NAME"
DECIMAL_PATTERNS = {
    ",": re.compile(r"[+-]?([1-9]\d{0,2}(\.\d{3})+|\d*)(,\d*)?([eE][+-]?\d+)?"),
    ".": re.compile(r"[+-]?([1-9]\d{0,2}(,\d{3})+|\d*)(\.\d*)?([eE][+-]?\d+)?"),
}
"""Patterns of numbers by decimal mark; the other mark may separate thousands."""


@dataclass(frozen=True)
class TextOptions:
    """Layout of a text as stated by the user; None: detected.

    Attributes:
        skip_rows: number of lines above the line of names, or above the numbers without names.
        units_row: number of the line of units; the first line of the file is 1.
        decimal: decimal mark, "," or "."; the other mark may separate thousands.
        encoding: Python's name of the encoding.
    """

    skip_rows: int | None = None
    units_row: int | None = None
    decimal: str | None = None
    encoding: str | None = None

    def __post_init__(self) -> None:
        for option, value, least in (
            ("--skip-rows", self.skip_rows, 0),
            ("--units-row", self.units_row, 1),
        ):
            if value is not None and value < least:
                raise UsageError(f"{option} {value}", expected=f"a whole number from {least} on")
        if self.decimal is not None and self.decimal not in DECIMAL_PATTERNS:
            raise UsageError(f"--decimal {self.decimal!r}", expected="a comma, or a point")
        if self.encoding is not None:
            try:
                "".encode(self.encoding)
                codecs.lookup(self.encoding)
            except (LookupError, ValueError) as error:
                raise UsageError(
                    f"--encoding {self.encoding!r}", expected="a name such as utf-8, cp1252, cp932"
                ) from error

    @property
    def has_layout_option(self) -> bool:
        """True if an option other than the encoding is set; the head is then not inspected."""
        return any(one is not None for one in (self.skip_rows, self.units_row, self.decimal))


@dataclass(frozen=True)
class TextLayout:
    """Layout of the columns of a text.

    Attributes:
        names: names of the columns; empty for a column without a name.
        delimiter: separator of cells; `BLANKS` for any number of blanks.
        first_data_line: index of the first line of numbers.
        units: units that the file states, by name.
        score: count of numbers minus count of other cells in the first line of numbers.
        is_named: True if a line names the columns; else they are numbered.
    """

    names: tuple[str, ...]
    delimiter: str
    first_data_line: int
    units: Mapping[str, str]
    score: int = 0
    is_named: bool = True


def parse_text_table(
    text: str, is_needed: ColumnFilter, values_max: int, options: TextOptions | None = None
) -> ForceTable:
    """Parse the needed columns of a text.

    Raises:
        FileFormatError: the text is too large, has no columns of numbers, or a cell of a needed
            column is no number.
    """
    options = options or TextOptions()
    units, skip = None, options.skip_rows or 0
    if options.units_row is not None:
        units, text = _cut_out_line(text, options.units_row - 1)
        if not units.strip():
            raise FileFormatError(
                f"line {options.units_row}, of units, is empty",
                expected="the line of units",
                remedy="State another --units-row",
            )
        skip -= options.units_row <= skip
    text = text[_line_offset(text, skip) :]
    if skip and not text.strip():
        raise FileFormatError(
            f"there is no text below {options.skip_rows} lines",
            expected="fewer lines above the names",
            remedy="State another --skip-rows",
        )
    layout = _detect_layout(text, options)
    if units is not None:
        cells = split_trimmed_cells_without_empty_end(units, layout.delimiter)
        layout = replace(layout, units={**layout.units, **_units_by_name(layout.names, cells)})
    needed = select_needed_names_or_empty(layout.names, is_needed)
    columns = parse_columns(
        text, layout, needed, values_max, options.decimal, mixed_marks_remedy=DECIMAL_REMEDY
    )
    notes = () if layout.is_named else ("no line names its columns: they are numbered from 1 on",)
    return make_table_with_lowercase_standard_names(
        layout.names, columns, units=layout.units, notes=notes, expected_form=FORM
    )


def read_decoded_text(path: Path, encoding: str | None = None, *, no_text_remedy: str = "") -> str:
    r"""Read and decode a text in the given or detected encoding; line ends become `\n`.

    Raises:
        OSError: the file cannot be read, or is too large.
        FileFormatError: it is no text.
    """
    content = read_bytes(path, bytes_max=TEXT_BYTES_MAX)
    try:
        text = content.decode(encoding).removeprefix("\ufeff") if encoding else decode_text(content)
    except UnicodeError as error:
        if encoding is not None:
            raise FileFormatError(
                f"it is no text in {encoding}",
                expected=f"a text in {encoding}",
                remedy="State another --encoding",
            ) from error
        # Names and titles of older programs; numbers are equal in all such encodings.
        text = content.decode("cp1252", errors="replace")
    if "\0" in text[:HEAD_CHARACTERS]:
        raise FileFormatError("cannot be read: it is no text", remedy=no_text_remedy)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _detect_layout(text: str, options: TextOptions) -> TextLayout:
    """Detect the line of names, if any, and the delimiter of columns.

    Raises:
        FileFormatError: there are no columns of numbers, or two delimiters are possible.
    """
    lines = list(islice(_lines(text[:HEAD_CHARACTERS]), HEAD_LINES))
    first = next((line for line in lines if line.strip()), "")
    sep = re.fullmatch(r"(?i)\"?sep=(.)\"?", first)
    delimiters = [sep[1]] if sep else [*DELIMITERS]
    is_first = options.skip_rows is not None
    named = (_detect_named_layout(lines, one, is_first=is_first) for one in delimiters)
    if found := [layout for layout in named if layout is not None]:
        return max(found, key=lambda layout: layout.score)
    if not first:
        raise FileFormatError("cannot be read: it is empty")
    delimiters = [one for one in delimiters if (one, options.decimal) != (",", ",")]
    nameless = (_detect_nameless_layout(lines, one, is_first=is_first) for one in delimiters)
    found = [layout for layout in nameless if layout is not None]
    if not found:
        raise FileFormatError(
            "no line of names precedes the numbers",
            remedy="State the number of lines above it: --skip-rows N",
        )
    best = max(found, key=lambda layout: layout.score)
    if options.decimal is None and best.delimiter == "," and best.score > 1 and len(found) > 1:
        raise FileFormatError(
            f"{lines[best.first_data_line][:40]!r} may be two numbers, or one with a decimal comma",
            remedy=DECIMAL_REMEDY,
        )
    return best


def parse_columns(
    text: str,
    layout: TextLayout,
    needed_names: Sequence[str],
    values_max: int,
    decimal_mark: str | None = None,
    *,
    mixed_marks_remedy: str = "Save it with decimal points",
) -> dict[str, Column]:
    """Return the numbers of the needed columns, without trailing empty lines.

    The decimal mark is detected if `decimal_mark` is None.

    Raises:
        FileFormatError: a cell is no number, or there are too many numbers.
        pa.ArrowException: lines differ in their number of cells.
    """
    body = _data_lines(text, layout)
    check_table_size(body.count("\n"), len(needed_names), values_max)
    if not body or not needed_names:
        return {name: np.empty(0) for name in needed_names}
    source: Any = pa.BufferReader(body.encode())  # its stubs know no buffers
    indices = [str(layout.names.index(name)) for name in needed_names]
    table = pyarrow.csv.read_csv(
        source,
        read_options=pyarrow.csv.ReadOptions(
            column_names=[str(i) for i in range(len(layout.names))]
        ),
        parse_options=pyarrow.csv.ParseOptions(delimiter=layout.delimiter, newlines_in_values=True),
        convert_options=pyarrow.csv.ConvertOptions(
            include_columns=indices,
            column_types=dict.fromkeys(indices, pa.string()),
            strings_can_be_null=False,
        ),
    )
    cells = {
        name: pc.utf8_trim_whitespace(table[index]).combine_chunks()
        for name, index in zip(needed_names, indices, strict=True)
    }
    if decimal_mark is not None:
        cells = {
            name: _to_decimal_points(column, name, decimal_mark) for name, column in cells.items()
        }
    has_comma = decimal_mark is None and _has_decimal_comma(
        list(cells.values()), mixed_marks_remedy
    )
    columns = {
        name: _parse_numbers(column, name, has_comma=has_comma) for name, column in cells.items()
    }
    filled = np.flatnonzero(np.any([~np.isnan(column) for column in columns.values()], axis=0))
    count = int(filled[-1]) + 1 if len(filled) else 0
    return {name: column[:count] for name, column in columns.items()}


def _lines(text: str) -> Iterator[str]:
    begin = 0
    while begin < len(text):
        end = text.find("\n", begin)
        end = len(text) if end < 0 else end
        yield text[begin:end]
        begin = end + 1


def _line_offset(text: str, number: int) -> int:
    """Return the offset of line `number`, from 0; the length of the text if it has fewer lines."""
    begin = 0
    for _ in range(number):
        begin = text.find("\n", begin) + 1
        if begin == 0:
            return len(text)
    return begin


def _cut_out_line(text: str, number: int) -> tuple[str, str]:
    """Return line `number` of a text, and the text without this line."""
    begin = _line_offset(text, number)
    line, end, rest = text[begin:].partition("\n")
    return line, text[:begin] + rest if end else text[:begin]


def _detect_named_layout(
    lines: Sequence[str], delimiter: str, *, is_first: bool
) -> TextLayout | None:
    """Return the layout with this delimiter; None if no line of names matches.

    Of several candidates for the line of names, the one with most numbers below wins: other lines
    state single values, such as a rate. With `is_first` the first line has the names.
    """
    rows = [
        (number, split_trimmed_cells_without_empty_end(line, delimiter))
        for number, line in enumerate(lines)
    ]
    rows = [(number, cells) for number, cells in rows if any(cells)]
    comments = {number for number, _ in rows if COMMENT_START.match(lines[number])}
    found: list[TextLayout] = []
    for i, (number, cells) in enumerate(rows[:1] if is_first else rows):
        is_comment = number in comments
        names = (
            split_trimmed_cells_without_empty_end(COMMENT_START.sub("", lines[number]), delimiter)
            if is_comment
            else cells
        )
        if len(names) < 2 or any(map(is_number, names)):
            continue
        below = [row for row in rows[i + 1 :] if row[0] not in comments]
        units = below.pop(0)[1] if below and _are_units(below[0][1]) else []
        if not below and len(rows) == i + 1 + bool(units) and not is_comment:
            found.append(_make_layout(names, units, delimiter, len(lines), []))
        elif below and (len(below[0][1]) == len(names) or not (is_comment or delimiter == BLANKS)):
            first, numbers = below[0]
            if len(numbers) <= len(names) and any(map(is_number, numbers)):
                width = len(split_csv_cells(lines[first], delimiter))
                padded = [*names, *[""] * (width - len(names))]
                found.append(_make_layout(padded, units, delimiter, first, numbers))
    return max(found, key=lambda layout: layout.score, default=None)


def _detect_nameless_layout(
    lines: Sequence[str], delimiter: str, *, is_first: bool
) -> TextLayout | None:
    """Return the layout of numbers without a line of names; None if the delimiter does not fit."""
    for number, line in enumerate(lines):
        cells = split_trimmed_cells_without_empty_end(line, delimiter)
        if not any(cells) or COMMENT_START.match(line):
            continue
        if all(map(is_number, cells)):
            names = tuple(f"column{i + 1}" for i in range(len(split_csv_cells(line, delimiter))))
            return TextLayout(names, delimiter, number, {}, len(cells), is_named=False)
        if is_first:
            return None
    return None


def _make_layout(
    names: Sequence[str], units: Sequence[str], delimiter: str, line: int, numbers: Sequence[str]
) -> TextLayout:
    stated = {name: match[1] for name in names if (match := _UNIT_IN_BRACKETS.search(name))}
    stated |= _units_by_name(names, units)
    count = sum(map(is_number, numbers))
    others = sum(map(bool, numbers)) - count
    return TextLayout(tuple(names), delimiter, line, stated, count - others)


def _units_by_name(names: Sequence[str], units: Sequence[str]) -> dict[str, str]:
    pairs = zip(names, units, strict=False)
    return {name: unit.strip("[]() ") for name, unit in pairs if name and unit}


def split_csv_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line of CSV without their quotes, trailing empty cells included."""
    if delimiter == BLANKS:
        return line.split()
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:  # a cell of more than 128 kB
        return []


def split_trimmed_cells_without_empty_end(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line with normalised blanks, without trailing empty cells."""
    cells = [" ".join(cell.split()) for cell in split_csv_cells(line, delimiter)]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def is_number(cell: str) -> bool:
    """Return whether a cell is a number, with a decimal point or a decimal comma."""
    return _NUMBER_PATTERN.fullmatch(cell) is not None


def _are_units(cells: Sequence[str]) -> bool:
    units = [cell.strip("[]() ").lower() for cell in cells if cell]
    known = sum(unit in KNOWN_UNITS for unit in units)
    return known > 0 and 2 * known >= len(units) and not any(map(is_number, units))


def _data_lines(text: str, layout: TextLayout) -> str:
    """Return the lines of numbers, without comments."""
    body = text[_line_offset(text, layout.first_data_line) :].rstrip(" \n\x1a\x00")
    if not body:
        return ""
    if layout.delimiter == BLANKS:
        body = "\n".join(" ".join(line.split()) for line in body.split("\n"))
    if any(mark in body for mark in ("#", "%", "//")):
        body = "\n".join(line for line in body.split("\n") if not COMMENT_START.match(line))
    return body + "\n"


def _has_decimal_comma(columns: Sequence[pa.Array[Any]], remedy: str) -> bool:
    """Return whether numbers have a decimal comma.

    Raises:
        FileFormatError: commas and points are mixed, or commas may separate thousands.
    """
    commas = [pc.filter(cells, pc.match_substring(cells, ",")) for cells in columns]
    first = next((cells[0].as_py() for cells in commas if len(cells)), None)
    if first is None:
        return False
    expected = "a decimal point, or a decimal comma, in all numbers, and nothing between thousands"
    number = r"^[+-]?\d*\.\d*([eE][+-]?\d+)?$"
    for cells in columns:
        if pc.any(pc.match_substring_regex(cells, number)).as_py():
            raise FileFormatError(
                f"some numbers have a decimal point, and {first!r} has a comma",
                expected=expected,
                remedy=remedy,
            )
    if all(
        pc.all(pc.match_substring_regex(cells, _AMBIGUOUS_COMMA)).as_py() is not False
        for cells in commas
    ):
        raise FileFormatError(
            f"{first!r} may have a decimal comma, or a comma between thousands",
            expected=expected,
            remedy=remedy,
        )
    return True


def _to_decimal_points(cells: pa.Array[Any], name: str, decimal: str) -> pa.Array[Any]:
    """Return numbers with the stated decimal mark as numbers with a decimal point.

    Raises:
        FileFormatError: a cell does not fit the stated decimal mark.
    """
    other = "." if decimal == "," else ","
    marked = pc.or_(pc.match_substring(cells, ","), pc.match_substring(cells, "."))
    marked = pc.and_(marked, pc.invert(pc.match_substring_regex(cells, MISSING_VALUE_PATTERN)))
    fits = pc.match_substring_regex(cells, f"^({DECIMAL_PATTERNS[decimal].pattern})$")
    if pc.any(bad := pc.and_(marked, pc.invert(fits))).as_py():
        at = pc.index(bad, pa.scalar(True)).as_py()
        raise FileFormatError(
            f"column {name} has {cells[at].as_py()[:40]!r} in row {at + 1} of its numbers",
            expected=f"{decimal!r} as the mark of decimals, and {other!r} between thousands only",
            remedy="State the other --decimal, or none",
        )
    return pc.replace_substring(pc.replace_substring(cells, other, ""), decimal, ".")


def _parse_numbers(cells: pa.Array[Any], name: str, *, has_comma: bool) -> Column:
    cells = pc.if_else(pc.match_substring_regex(cells, MISSING_VALUE_PATTERN), None, cells)
    if name.lower() == INSTANT_COLUMN and not cells.null_count:
        try:
            return np.asarray(cells.cast(pa.int64()).to_numpy(), dtype=np.int64)
        except pa.ArrowException:
            pass  # not int64: the reader of the table refuses it
    plain = pc.replace_substring(cells, ",", ".") if has_comma else cells
    try:
        return arrow_to_floats(plain.cast(pa.float64()))
    except pa.ArrowException as error:
        at, text = next((i, c) for i, c in enumerate(cells.to_pylist()) if c and not _is_float(c))
        raise FileFormatError(
            f"column {name} is not numeric: {text[:40]!r} in row {at + 1} of its numbers",
            expected="numbers",
        ) from error


def arrow_to_floats(column: pa.Array[Any]) -> Floats:
    """Return an Arrow column as float64, NaN for null."""
    return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)


def _is_float(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True

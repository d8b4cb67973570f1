"""Text files of columns in every form that spreadsheets and measuring programs save."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError, LoadTraceError, UsageError
from storage.formats.load_trace import read_load_to_emulate
from storage.formats.readers.registry import TABLE_FORMATS, TEXT, read_table
from storage.formats.readers.table import ForceTable
from storage.formats.readers.text import FORM, TextOptions
from storage.formats.reference import ReferenceOptions, read_reference

PLAIN = "Time,Fz\n0.00,0.5\n0.01,-12.25\n0.02,1e3\n"
FORMS: dict[str, Callable[[str], str | bytes]] = {
    "as it is": str,
    "lines end as on an old Mac": lambda text: text.replace("\n", "\r"),
    "quoted names": lambda text: text.replace("Time,Fz", '"Time","Fz"').encode("utf-8-sig"),
    "quoted cells": lambda text: "".join(
        ",".join(f'"{cell}"' for cell in line.split(",")) + "\n" for line in text.splitlines()
    ),
    "UTF-16 without a mark": lambda text: text.encode("utf-16-le"),
    "UTF-16 of big endians": lambda text: text.encode("utf-16-be"),
    "a title in Latin-1": lambda text: ("Vorwärts, Nr. 1\n" + text).encode("latin-1"),
    "blanks": lambda text: text.replace(",", "    "),
    "decimal commas": lambda text: text.replace(",", ";").replace(".", ","),
    "decimal commas in quotes": lambda text: "".join(
        ",".join(f'"{cell}"' for cell in line.replace(",", ";").replace(".", ",").split(";")) + "\n"
        for line in text.splitlines()
    ),
    "empty columns at the end": lambda text: text.replace("\n", ",,\n"),
    "a comma at the end of numbers": lambda text: PLAIN[:8] + text[8:].replace("\n", ",\n"),
    "empty columns above numbers only": lambda text: text.replace("Fz\n", "Fz,,\n"),
    "empty lines at the end": lambda text: text + ",\n,\n\n",
    "a blank line above the names": lambda text: "\n" + text,
    "an empty line of Excel above the names": lambda text: ",\n" + text,
    "a blank line below the names": lambda text: text.replace("Fz\n", "Fz\n\n"),
    "Excel's line of the delimiter": lambda text: "sep=,\n" + text,
    "Excel's line of another delimiter": lambda text: "sep=|\n" + text.replace(",", "|"),
    "comments above": lambda text: "# plate 1\n% 2 columns, of 3\n" + text,
    "comments between": lambda text: text.replace("0.01", "# turned\n0.01"),
    "names in a comment": lambda text: "# plate 1\n# " + text,
    "a title": lambda text: "Plate 1 of 2\nMonday\n" + text,
    "facts above": lambda text: "Rate (Hz),1000\nSamples,3\n\n" + text,
    "a line of units": lambda text: text.replace("Fz\n", "Fz\n(s),[N]\n"),
}


def table_of(
    folder: Path, content: str | bytes, name: str = "plate.csv", stated: TextOptions | None = None
) -> ForceTable:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_table(path, lambda name: True, text_options=stated)


@pytest.mark.parametrize("form", FORMS)
def test_the_same_numbers_are_read_in_any_form(tmp_path: Path, form: str) -> None:
    found = table_of(tmp_path, FORMS[form](PLAIN))
    assert [name for name in found.names if name] == ["Time", "Fz"]
    np.testing.assert_array_equal(found.columns["Time"], [0.0, 0.01, 0.02])
    np.testing.assert_array_equal(found.columns["Fz"], [0.5, -12.25, 1000.0])


CELLS = st.one_of(st.none(), st.floats(-1e6, 1e6).map(lambda x: round(x, 5)))


@settings(max_examples=60)
@given(
    rows=st.lists(st.tuples(CELLS, CELLS, CELLS), min_size=1, max_size=8),
    delimiter=st.sampled_from(",;\t"),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    end=st.sampled_from(["\n", "\r\n"]),
    has_comma=st.booleans(),
    blank=st.sampled_from(["", " "]),
)
def test_numbers_and_empty_cells_survive_any_dialect(
    tmp_path_factory: pytest.TempPathFactory,
    rows: list[tuple[float | None, ...]],
    delimiter: str,
    encoding: str,
    end: str,
    has_comma: bool,
    blank: str,
) -> None:
    # The first column is always known, as time is; and no number looks like grouped thousands.
    rows = [(i + 0.5, *row[1:]) for i, row in enumerate(rows)]
    has_comma = has_comma and delimiter != ","
    cells = [["" if x is None else repr(x) for x in row] for row in rows]
    if has_comma:
        cells = [[cell.replace(".", ",") for cell in row] for row in cells]
    lines = [["Größe", "F z", "x (mm)"], *cells]
    text = end.join((delimiter + blank).join(line) for line in lines) + end
    found = table_of(tmp_path_factory.mktemp("text"), text.encode(encoding))
    assert found.names == ("Größe", "F z", "x (mm)")
    for i, name in enumerate(found.names):
        expected = [np.nan if row[i] is None else row[i] for row in rows]
        np.testing.assert_array_equal(found.columns[name], expected)


@pytest.mark.parametrize(
    "cell",
    [
        *("", "NaN", "nan", "-nan", "-nan(ind)", "nan(snan)", "1.#QNAN", "-1.#IND", "-1.#IND00"),
        *("N/A", "#N/A", "NA", "null", "None"),
    ],
)
def test_words_for_no_number_are_nan(tmp_path: Path, cell: str) -> None:
    found = table_of(tmp_path, PLAIN.replace("-12.25", cell))
    np.testing.assert_array_equal(found.columns["Fz"], [0.5, np.nan, 1000.0])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "it is empty"),
        ("alone\nhere\n", "no line of names"),
        ("alone\nhere\n", "--skip-rows N"),
        ("633,21\n628,46\n", "may be two numbers, or one with a decimal comma"),
        ("633,21\n628,46\n", "--decimal"),
        (PLAIN.replace("1e3", "much"), "column Fz is not numeric: 'much' in row 3"),
        (PLAIN.replace("1e3", "much"), "of its numbers; expected numbers"),
        (PLAIN + "0.03\n", "cannot be read"),
        (PLAIN + "0.03,1,2\n", "cannot be read"),
        ("t;Fz\n0.0;1,5\n", "have a decimal point, and '1,5' has a comma"),
        ("t;Fz\n0.0;1,5\n", "--decimal , or --decimal ."),
        ("t;Fz\n0;1,000\n1;1,500\n", "--decimal , or --decimal ."),
        ("t;Fz\n0;1,000\n1;1,500\n", "or a comma between thousands"),
        ('t,Fz\n0.5,"1,000.5"\n', "has a comma"),
    ],
)
def test_an_ambiguous_text_is_refused(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        table_of(tmp_path, text)
    assert says in str(caught.value)


def test_units_are_read_from_brackets_and_from_a_line_of_units(tmp_path: Path) -> None:
    named = table_of(tmp_path, "t [ms],F (kN)\n0,1\n5,2\n")
    assert named.units == {"t [ms]": "ms", "F (kN)": "kN"}
    below = table_of(tmp_path, "t,F,k\nms,kN,\n0,1,3\n5,2,3\n")
    assert below.units == {"t": "ms", "F": "kN"}


def test_a_unit_in_the_file_cannot_be_contradicted(tmp_path: Path) -> None:
    path = tmp_path / "plate.csv"
    path.write_text("t (ms),F (kN)\n0,0\n5,0.5\n")
    columns = {"time_s": "t (ms)", "grf_n": "F (kN)"}
    for units in ({}, {"grf": "kN"}, {"grf": "kN", "time": "ms"}):
        found = read_reference(path, ReferenceOptions(columns, units, "+"))
        np.testing.assert_allclose(found.time_s, [0.0, 0.005])
        np.testing.assert_allclose(found.grf_n, [0.0, 500.0])
    with pytest.raises(ValueError, match=r"in kN, not in N.*Leave out --units grf=N"):
        read_reference(path, ReferenceOptions(columns, {"grf": "N"}, "+"))


@pytest.mark.parametrize(
    ("text", "stated", "names", "units"),
    [
        ("a,b\n1,2\nt,F\n0,1\n5,2\n", TextOptions(skip_rows=2), ("t", "F"), {}),
        ("t,F\n0,1\n5,2\n", TextOptions(skip_rows=0), ("t", "F"), {}),
        ("9\n8\n0;1\n5;2\n", TextOptions(skip_rows=2), ("column1", "column2"), {}),
        ("ms,kN\nt,F\n0,1\n5,2\n", TextOptions(units_row=1), ("t", "F"), {"t": "ms", "F": "kN"}),
        (
            "\nms,kN,,\nt,F\n0,1\n5,2\n",
            TextOptions(skip_rows=2, units_row=2),
            ("t", "F"),
            {"t": "ms", "F": "kN"},
        ),
        (
            "Hall\nt;F\nsec.;1;N\nms;kN\n0;1\n5;2\n",
            TextOptions(skip_rows=3, units_row=4),
            ("column1", "column2"),
            {"column1": "ms", "column2": "kN"},
        ),
    ],
)
def test_rows_of_names_and_units_can_be_stated(
    tmp_path: Path, text: str, stated: TextOptions, names: tuple[str, ...], units: dict[str, str]
) -> None:
    found = table_of(tmp_path, text, stated=stated)
    assert (found.names, found.units) == (names, units)
    np.testing.assert_array_equal(found.columns[names[0]], [0.0, 5.0])
    np.testing.assert_array_equal(found.columns[names[1]], [1.0, 2.0])


@pytest.mark.parametrize(
    ("cells", "decimal", "numbers"),
    [
        (("1,000", "1,500"), ",", (1.0, 1.5)),
        (("1,000", "1,500"), ".", (1000.0, 1500.0)),
        (("1.000", "1.500"), ",", (1000.0, 1500.0)),
        (("1.234.567,5", "-,25"), ",", (1234567.5, -0.25)),
        (("1,234,567.5", "-.25"), ".", (1234567.5, -0.25)),
        (("1,5e3", "nan"), ",", (1500.0, np.nan)),
        (("1", "1.#QNAN"), ",", (1.0, np.nan)),
    ],
)
def test_the_mark_of_decimals_is_the_stated_one(
    tmp_path: Path, cells: tuple[str, str], decimal: str, numbers: tuple[float, float]
) -> None:
    text = "t;F\n0;{}\n1;{}\n".format(*cells)
    found = table_of(tmp_path, text, stated=TextOptions(decimal=decimal))
    np.testing.assert_array_equal(found.columns["F"], numbers)


@pytest.mark.parametrize(
    ("cell", "decimal"),
    [
        ("0.500", ","),
        ("1.5", ","),
        ("0,500", "."),
        ("1,5", "."),
        ("1.5,5.5", ","),
        ("12.34,5", ","),
    ],
)
def test_another_decimal_mark_is_refused(tmp_path: Path, cell: str, decimal: str) -> None:
    with pytest.raises(FileFormatError, match=r"column F has .* in row 2.*--decimal"):
        table_of(tmp_path, f"t;F\n0;1\n1;{cell}\n", stated=TextOptions(decimal=decimal))


def test_names_are_read_in_the_stated_encoding(tmp_path: Path) -> None:
    text = "時間;力 (N)\n0,0;1,5\n0,5;2,5\n".encode("cp932")
    garbled = ReferenceOptions({"time_s": "時間", "grf_n": "力 (N)"}, sign="+")
    path = tmp_path / "plate.csv"
    path.write_bytes(text)
    with pytest.raises(FileFormatError, match="if names are garbled, state --encoding"):
        read_reference(path, garbled)
    stated = ReferenceOptions(garbled.columns, {}, "+", text=TextOptions(encoding="cp932"))
    np.testing.assert_array_equal(read_reference(path, stated).grf_n, [1.5, 2.5])
    with pytest.raises(
        FileFormatError, match=r"no text in utf-8; expected a text in utf-8.*another --encoding"
    ):
        table_of(tmp_path, text, stated=TextOptions(encoding="utf-8"))
    without_mark = "t,F\n0,1\n".encode("utf-32-le")
    with pytest.raises(FileFormatError, match=r"no text.*--encoding NAME"):
        table_of(tmp_path, without_mark)
    assert table_of(tmp_path, without_mark, stated=TextOptions(encoding="utf-32-le")).names


@pytest.mark.parametrize(
    "stated",
    [
        {"skip_rows": -1},
        {"units_row": 0},
        {"decimal": ";"},
        {"decimal": ""},
        {"encoding": "hex"},
        {"encoding": "no such"},
        {"encoding": "a\0b"},
        {"encoding": ""},
    ],
)
def test_impossible_text_options_are_wrong_usage(stated: dict[str, int | str]) -> None:
    with pytest.raises(UsageError, match="--"):
        TextOptions(**stated)  # type: ignore[arg-type]  # mixed types of values


def test_rows_that_are_not_there_are_refused(tmp_path: Path) -> None:
    for stated, says in (
        (TextOptions(skip_rows=9), "below 9 lines; expected fewer lines .*another --skip-rows"),
        (TextOptions(skip_rows=10**30), "there is no text below"),
        (TextOptions(units_row=9), "line 9, of units, is empty; .*another --units-row"),
    ):
        with pytest.raises(FileFormatError, match=says):
            table_of(tmp_path, PLAIN, stated=stated)


def test_columns_that_no_line_names_are_numbered(tmp_path: Path) -> None:
    text = "\n-3.5, 953.25, 28.5\n-4.25, 950.0, 27.5\n-4.0, 0.0, 27.0\n"
    path = tmp_path / "plate.txt"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=r"it has column1, column2.*--skip-rows"):
        read_reference(path, ReferenceOptions())
    found = read_reference(
        path, ReferenceOptions({"grf_n": "column2"}, {"grf": "N"}, "+", rate_hz=100.0)
    )
    np.testing.assert_array_equal(found.grf_n, [953.25, 950.0, 0.0])
    np.testing.assert_allclose(found.time_s, [0.0, 0.01, 0.02])
    assert "no line names its columns: they are numbered from 1 on" in found.notes
    with pytest.raises(FileFormatError, match="or, without times, state --rate-hz"):
        read_reference(path, ReferenceOptions({"grf_n": "column2"}, {"grf": "N"}, "+"))


def test_the_expected_form_names_the_endings_of_all_other_formats() -> None:
    others = {ending for one in TABLE_FORMATS for ending in one.endings if one is not TEXT}
    assert set(re.findall(r"\.\w+", FORM)) == others


def test_text_options_are_for_texts_only(tmp_path: Path) -> None:
    for name in ("plate.c3d", "plate.parquet", "plate.mot"):
        with pytest.raises(UsageError, match="apply only to text tables"):
            table_of(tmp_path, PLAIN, name, TextOptions(decimal="."))
    with pytest.raises(LoadTraceError, match="apply only to text tables"):
        read_load_to_emulate(
            tmp_path / "plate.c3d", ReferenceOptions(text=TextOptions(skip_rows=1))
        )


def test_a_stated_layout_overrules_the_head_of_a_program(tmp_path: Path) -> None:
    text = "BioWare Version 5\nt\tFz\n0\t1\n1\t2\n"
    with pytest.raises(FileFormatError, match="no line of names"):
        table_of(tmp_path, text)
    assert table_of(tmp_path, text, stated=TextOptions(skip_rows=1)).names == ("t", "Fz")


def test_a_load_is_read_with_text_options(tmp_path: Path) -> None:
    path = tmp_path / "load.csv"
    path.write_text("a;b\n1;2\ntime_s;fz_n;cop_x_m;cop_y_m\n0;1,000;;\n1;1,500;;\n")
    found = read_load_to_emulate(path, ReferenceOptions(text=TextOptions(skip_rows=2, decimal=",")))
    assert found.fz_n is not None
    assert found.fz_n.tolist() == [1.0, 1.5]

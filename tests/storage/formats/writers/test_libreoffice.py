"""CSV in a spreadsheet: LibreOffice opens it, and what its cells hold is compared with Arrow."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from storage.formats.export import make_one_pass_frame_source
from storage.formats.markers import PlacedMarker, PlacedMarkers
from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from storage.sessions.folder import Marker
from tests.builders.arrays import make_array
from tests.storage.formats.exports import NOTES, cut, export, extra, frames, read
from tests.waiting import PATIENCE_S

pytestmark = [pytest.mark.process, pytest.mark.soak]

OFFICE = shutil.which("soffice")
POINT, COMMA = "CSV:44,34,76,1", "CSV:59,34,76,1,,1031"
"""What a user chooses when asked: what is between columns, quotes, UTF-8, from the first line on,
and the language of numbers: none, German."""
LABELS = ["=1+1", "+SUM(A1:A9)", "links; rechts, 1,5", "@x", 'a "stone" 😀']
_OFFICE = "{urn:oasis:names:tc:opendocument:xmlns:office:1.0}"
_TABLE = "{urn:oasis:names:tc:opendocument:xmlns:table:1.0}"
_TEXT = "{urn:oasis:names:tc:opendocument:xmlns:text:1.0}"


def exported(to: str, options: FormatOptions) -> bytes:
    first = int(frames().seq[0])
    markers = [
        PlacedMarker(Marker(id=str(i), label=label, t_ns=0), (0, first + i), 0, 0)
        for i, label in enumerate(LABELS)
    ]
    content = make_one_pass_frame_source(cut(frames(), extra(), 20))
    chunks = export(
        *(content, make_array(), NOTES, to, Slice()),
        markers=PlacedMarkers(markers),
        options=options,
    )
    return b"".join(chunks)


def cells(path: Path, how: str) -> list[list[Any]]:
    """What LibreOffice makes of a file: numbers, texts, None; a formula is an error."""
    folder = path.parent
    assert OFFICE is not None
    subprocess.run(
        [
            *(OFFICE, f"-env:UserInstallation=file://{folder}/profile", "--headless"),
            *(f"--infilter={how}", "--convert-to", "fods", "--outdir", folder, path),
        ],
        check=True,
        capture_output=True,
        timeout=PATIENCE_S,
        env={**os.environ, "HOME": str(folder)},
    )
    tree = ElementTree.parse(path.with_suffix(".fods"))  # noqa: S314  # LibreOffice's
    return [
        [value for cell in row for value in _values(cell)]
        for row in tree.iter(f"{_TABLE}table-row")
    ]


def _values(cell: ElementTree.Element) -> list[Any]:
    assert cell.get(f"{_TABLE}formula") is None
    times = int(cell.get(f"{_TABLE}number-columns-repeated", "1"))
    number = cell.get(f"{_OFFICE}value")
    texts = ["".join(text.itertext()) for text in cell.iter(f"{_TEXT}p")]
    value = float(number) if number is not None else "\n".join(texts) or None
    return [value] * times


@pytest.mark.in_turn
@pytest.mark.skipif(OFFICE is None, reason="LibreOffice is not installed: libreoffice-calc-nogui")
@pytest.mark.parametrize(
    ("how", "options"),
    [(POINT, NO_OPTIONS), (COMMA, FormatOptions(decimal="comma"))],
    ids=["point", "comma"],
)
def test_a_spreadsheet_reads_numbers_as_numbers_and_marks_as_text(
    tmp_path: Path, how: str, options: FormatOptions
) -> None:
    path = tmp_path / "session.csv"
    path.write_bytes(exported("csv", options))
    names, *rows = cells(path, how)
    expected = read(exported("arrow", NO_OPTIONS), "arrow")
    assert len(rows) == len(expected)
    for name in expected.column_names:
        column = [row[names.index(name)] if len(row) > names.index(name) else None for row in rows]
        values = expected[name].to_pylist()
        if name == "marker":
            shown = [f"'{label}" if label[0] in "=+@" else label for label in LABELS]
            assert column == [*shown, *[None] * (len(rows) - len(LABELS))]
        elif name in ("phase", "time_utc"):
            assert all(isinstance(cell, str) for cell in column)
        else:
            # A spreadsheet has 15 digits.
            assert column == [v if v is None else pytest.approx(v, rel=1e-7) for v in values], name

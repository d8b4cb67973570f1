"""What holds for each format of the registry: what a file says of itself, and what breaks off."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.errors import StorageError, UsageError
from service.offline.export import ExportOptions, export_session
from storage.clock.log import ClockOffset
from storage.clock.table import CLOCK_NAME, StreamClockFacts, write_clock_file
from storage.formats.export import Export, FlatColumns
from storage.formats.markers import PlacedMarker, PlacedMarkers
from storage.formats.slice import FormatOptions, Slice
from storage.formats.writers.registry import FORMATS
from storage.schema import Array
from storage.sessions.folder import FRAMES_NAME, Marker
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import UTC_NS
from tests.builders.frames import make_frames
from tests.storage.faulty_disk import disk_with_room_for
from tests.storage.formats.walks import ARRAY, ROWS, export_of_walk, lines_of_documents, walk
from tests.storage.formats.writers.readers import said_in

EACH = pytest.mark.parametrize("to", FORMATS)
FACTS = ("complete", "time_base", "axes", "resampled", "filled", "masked")
WHOLE = {"complete": True, "lossy": False, "parts": [{"lost": {}}]}
LOSSY = {"complete": False, "lossy": True, "parts": [{"lost": {"disk_full": 40}}]}
ODD = "../a 'b' \"c\" <d>; é 🦶\t=1+1"


def written(to: str, export: Export) -> bytes:
    return b"".join(FORMATS[to].encode(export))


def said(to: str, export: Export) -> Mapping[str, str]:
    (found,) = said_in(to, written(to, export))
    return found


@EACH
@pytest.mark.parametrize(
    ("notes", "source", "complete"),
    [
        ({"ledger": WHOLE}, {}, ("true", "complete")),
        ({"ledger": LOSSY}, {}, ("lossy",)),
        ({}, {"state": "recording"}, ("false", "not complete: it is recording")),
        ({}, {}, ("null", "none", "not known")),
    ],
    ids=["complete", "lossy", "recording", "simulated"],
)
def test_a_file_states_its_completeness_and_how_it_was_made(
    to: str, notes: dict[str, object], source: dict[str, object], complete: Sequence[str]
) -> None:
    facts = said(to, export_of_walk(notes=notes, provenance={"session": "s1", **source}))
    for name in FACTS:
        assert facts[name], name
    assert facts["complete"].lower().startswith(tuple(complete))
    assert facts["session"] == "s1"
    assert "node's clock" in facts["time_base"]
    assert "x forward" in facts["axes"]
    lost = facts["complete"] + facts.get("lost", "")
    assert ("40" in lost and "disk_full" in lost) == (notes == {"ledger": LOSSY})
    has_a_rate = to in ("c3d", "opensim")
    assert ("Hz" in facts["resampled"], facts["resampled"] == "nothing") == (
        has_a_rate,
        not has_a_rate,
    )


@EACH
def test_names_of_any_letters_break_nothing(to: str) -> None:
    info = ARRAY.model_copy(update={"node": ODD})
    event = Marker(id="1" * 12, label=ODD, t_ns=0)
    export = export_of_walk(
        info=info,
        provenance={"session": ODD},
        markers=PlacedMarkers([PlacedMarker(event, (0, 3), 0, 0)]),
    )
    facts = said(to, export)
    assert "b" in facts["session"]
    assert facts["complete"]


@pytest.mark.parametrize("to", [to for to in FORMATS if to != "parquet"])
def test_the_same_session_is_the_same_bytes(to: str) -> None:
    assert written(to, export_of_walk()) == written(to, export_of_walk())


@pytest.mark.parametrize("to", ["c3d", "opensim", "mat"])
def test_more_frames_than_fit_are_refused_with_the_slice_that_does(
    to: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "matlab" if to == "mat" else to
    monkeypatch.setattr(f"storage.formats.writers.{module}.FRAMES_MAX", 700)
    with pytest.raises(UsageError, match=r"more than 700 frames.* 0 s to 1\.400 s fits"):
        written(to, export_of_walk())
    assert written(to, export_of_walk(part=Slice(0.0, 1.4)))


@pytest.mark.parametrize(("to", "section"), [("c3d", "C3D"), ("mcap", "MCAP"), ("xdf", "XDF")])
def test_the_lines_of_the_documents_read_it(
    to: str, section: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = ARRAY.model_copy(update={"node": "left"})
    (tmp_path / f"session.{to}").write_bytes(written(to, export_of_walk(info=info)))
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {}
    exec(lines_of_documents(section), found)  # noqa: S102  # our own
    grf_n, on = walk()["grf_n"], walk()["contact"] == 1
    expected = {"c3d": on * grf_n, "mcap": grf_n[-1], "xdf": grf_n}[to]
    np.testing.assert_allclose(found["grf_n"], expected, atol=1e-5)
    if to == "c3d":
        np.testing.assert_allclose(found["cop_m"][0], walk()["cop_x_m"], atol=1e-6)
        assert found["events"][0] == (pytest.approx(0.2), "Foot Strike")
        assert found["complete"] == ["not known: there is no ledger"]


@EACH
def test_a_session_without_estimates_is_its_counts_or_refused(to: str) -> None:
    raw = export_of_walk({"part": np.zeros(ROWS, dtype=np.uint16)}, notes={"estimates": "no curve"})
    if FORMATS[to].needs_forces:
        match = r"holds forces.* none: no curve.*foottile estimate.*Parquet, Arrow or CSV"
        with pytest.raises(UsageError, match=match):
            written(to, raw)
    else:
        assert said(to, raw)["complete"]


def untared() -> dict[str, Array]:
    """Estimates before the first tare: nothing is known."""
    columns = {name: values.copy() for name, values in walk().items()}
    for name in ("grf_n", "force_n", "cop_x_m", "cop_y_m"):
        columns[name][:] = np.nan
    columns["estimate_flags"][:] = 512
    return columns


@EACH
def test_a_session_without_a_tare_has_no_forces_or_is_refused(to: str) -> None:
    export = export_of_walk(untared())
    if FORMATS[to].needs_forces:
        with pytest.raises(
            UsageError, match=r"none of its 1000 frames has a force \(estimate_flags 512\)"
        ):
            written(to, export)
    else:
        assert "They are not replaced" in said(to, export)["masked"]


# --- what breaks off ------------------------------------------------------------------------------


class Watched:
    """Frames of which is known whether somebody still reads them."""

    def __init__(self, export: Export) -> None:
        self.open = 0
        self.export = replace(
            export, frame_source=replace(export.frame_source, read_columns=self._read)
        )
        self._given = export.frame_source.read_columns

    def _read(self, names: Sequence[str]) -> Iterator[FlatColumns]:
        self.open += 1
        try:
            yield from self._given(names)
        finally:
            self.open -= 1


@EACH
def test_an_aborted_download_leaves_nothing_open_or_behind(
    to: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    watched = Watched(export_of_walk(every=100))
    chunks: Any = FORMATS[to].encode(watched.export)
    next(chunks)
    chunks.close()
    assert watched.open == 0
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session's frames, with its clock beside them."""
    path = tmp_path_factory.mktemp("sealed") / FRAMES_NAME
    notes = {"session": {"id": "s1"}, "ledger": WHOLE}
    with SealedFileWriter(path, ARRAY, notes) as writer:
        writer.append_frames(make_frames(ROWS, len(ARRAY.tiles)), walk())
    row = ClockOffset(
        stream_id=ARRAY.stream_id, t_mono_ns=0, server_minus_node_ns=0, uncertainty_ns=400_000
    )
    write_clock_file(
        path.with_name(CLOCK_NAME), [row], [StreamClockFacts(ARRAY.stream_id, UTC_NS, True)]
    )
    return path


@EACH
def test_a_full_disk_leaves_no_file_and_what_was_there_before(
    to: str, sealed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    out = tmp_path / f"session{FORMATS[to].ending}"
    out.write_bytes(b"of before")
    with disk_with_room_for(2_000), pytest.raises(StorageError):
        export_session(sealed, out, ExportOptions(to))
    assert out.read_bytes() == b"of before"
    assert {each.name for each in tmp_path.iterdir()} == {out.name, "temporary"}
    assert not list(temporary.iterdir())
    export_session(sealed, out, ExportOptions(to))
    assert len(said_in(to, out.read_bytes())) == 1


# --- CSV ------------------------------------------------------------------------------------------


def test_csv_says_so_in_one_cell_unless_columns_are_chosen() -> None:
    rows = written("csv", export_of_walk()).decode().splitlines()
    assert rows[0].endswith(',"about"')
    assert all(row.endswith(",") for row in rows[2:])
    told = written("csv", export_of_walk(options=FormatOptions(about=False))).decode()
    assert "about" not in told
    assert json.loads(said("csv", export_of_walk())["lost"]) == {}

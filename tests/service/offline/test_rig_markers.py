"""A calibration from a recording of a server: what the mill did is in its markers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from devices.errors import CalibrationError
from service.offline.calibration_fit import read_indentations
from storage.sessions.folder import FRAMES_NAME, Marker, Session, SessionsFolder
from storage.sessions.metadata import write_markers
from tests.service import benches

pytestmark = pytest.mark.slow


@pytest.fixture
def recorded(bench_cache: Path, tmp_path: Path) -> Path:
    """Folder of a bench session, sealed, with its markers."""
    return benches.put(benches.pressed(bench_cache), tmp_path)


def session_in(folder: Path) -> Session:
    return SessionsFolder(folder.parent).load(folder.name)


def marked(folder: Path, *events: Marker) -> Path:
    """The same, with other markers."""
    write_markers(session_in(folder).model_copy(update={"markers": events}), folder)
    return folder / FRAMES_NAME


def test_marks_say_the_same_as_the_mills_own_notes(recorded: Path, bench_cache: Path) -> None:
    (by_notes,), (by_marks,) = (
        read_indentations([path])["T01"]
        for path in (benches.pressed(bench_cache), recorded / FRAMES_NAME)
    )
    assert set(by_notes.indentation.phase) >= {"rest", "load", "unload", "hold", "release"}
    assert (by_marks.registers, by_marks.stream_id, by_marks.seq_range) == (
        by_notes.registers,
        by_notes.stream_id,
        by_notes.seq_range,
    )
    names = ("t_ns", "kpa", "reference_n", "phase", "is_under_indenter", "temperature_raw")
    with_spindle = by_notes.indentation.is_under_indenter
    for name in names:
        noted, marked_as = (getattr(one.indentation, name) for one in (by_notes, by_marks))
        rows = with_spindle if name == "reference_n" else slice(None)
        np.testing.assert_array_equal(marked_as[rows], noted[rows], err_msg=name)


def test_nothing_is_under_the_spindle_in_a_soak_and_after_the_end(recorded: Path) -> None:
    steps = session_in(recorded).markers[1:]
    newest, *_ = steps
    for label, phase in (("soak", "soak"), ("end", "rest")):
        path = marked(recorded, newest.model_copy(update={"label": label}), *steps[1:])
        ((found,),) = read_indentations([path]).values()
        assert found.indentation.phase[-1] == phase
        assert not found.indentation.is_under_indenter[-1]


@pytest.mark.parametrize(
    ("label", "says"),
    [
        ("T01 laod", "is no calibration step"),
        ("T09 load", "of a tile of T01"),
        ("T01 500", "or a weight such as 500 g"),
        ("load", "is no calibration step"),
        ("Soak", "is no calibration step"),
    ],
)
def test_a_step_that_is_misspelt_is_refused_and_no_stroke_goes_on(
    recorded: Path, label: str, says: str
) -> None:
    wrong, *others = session_in(recorded).markers[1:]
    path = marked(recorded, wrong.model_copy(update={"label": label}), *others)
    with pytest.raises(CalibrationError, match=says):
        read_indentations([path])


def test_a_recording_without_a_step_or_markers_is_refused(recorded: Path) -> None:
    path = marked(recorded, session_in(recorded).markers[0])
    with pytest.raises(CalibrationError, match="markers such as `T01 load`"):
        read_indentations([path])
    (recorded / "markers.parquet").unlink()
    with pytest.raises(CalibrationError, match="not an indentation recording"):
        read_indentations([path])


def test_a_mark_that_names_a_weight_is_a_step(recorded: Path) -> None:
    newest, *others = session_in(recorded).markers[1:]
    path = marked(recorded, newest.model_copy(update={"label": "T01 500 g +-0.5 %"}), *others)
    ((found,),) = read_indentations([path]).values()
    assert found.indentation.phase[-1] == "500 g +-0.5 %"
    assert found.indentation.is_under_indenter[-1]

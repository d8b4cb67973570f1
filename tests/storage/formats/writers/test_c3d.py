"""C3D: read again by a reader that has nothing of the writer's, and as a reference of our own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from devices.errors import StorageError, UsageError, escape_control_chars
from devices.flags import CONTACT_UNKNOWN
from storage.formats.export import Export
from storage.formats.markers import PlacedMarker, PlacedMarkers
from storage.formats.reference import ReferenceOptions, read_reference
from storage.formats.slice import Slice
from storage.formats.writers import c3d as written_c3d
from storage.formats.writers.c3d import C3D
from storage.sessions.folder import Marker
from tests.builders.arrays import PERIOD_NS
from tests.storage.formats.walks import (
    ARRAY,
    LATE_NS,
    RATE_HZ,
    ROW,
    ROWS,
    STANCES,
    export_of_walk,
    row_walk,
    saturated,
    two_feet,
    walk,
)
from tests.storage.formats.writers.readers import C3dFile

pytest.importorskip("ezc3d")
pytest.importorskip("c3d")


class Read(C3dFile):
    """What was written of an export, or of several."""

    def __init__(self, export: Export | list[Export]) -> None:
        chunks = (
            C3D.encode_together_on_server_clock(export)
            if isinstance(export, list)
            else C3D.encode(export)
        )
        self.content = b"".join(chunks)
        super().__init__(self.content)


@pytest.fixture(scope="module")
def plain() -> Read:
    return Read(export_of_walk())


def test_forces_and_moments_are_those_of_the_manual(plain: Read) -> None:
    columns = walk()
    on = columns["contact"] == 1
    np.testing.assert_array_equal(plain.channel("Fz1"), np.float32(0.0 - on * columns["grf_n"]))
    for name in ("Fx1", "Fy1", "Mz1"):
        np.testing.assert_array_equal(plain.channel(name), 0.0)
    # Of the manual: in a platform's axes, z down, a force at (x, y) has moments y Fz and -x Fz.
    fz = plain.channel("Fz1").astype(np.float64)
    corners = np.reshape(plain.reader.get("FORCE_PLATFORM:CORNERS").float_array, (4, 3))
    middle = corners.mean(axis=0)
    along = (corners[3] - corners[2]) / np.linalg.norm(corners[3] - corners[2])
    across = (corners[1] - corners[2]) / np.linalg.norm(corners[1] - corners[2])
    np.testing.assert_allclose(np.cross(along, across), [0, 0, -1], atol=1e-6)
    with np.errstate(all="ignore"):
        x, y = -plain.channel("My1") / fz, plain.channel("Mx1") / fz
    cop_mm = middle[:2] + x[:, None] * along[:2] + y[:, None] * across[:2]
    np.testing.assert_allclose(cop_mm[:, 0], 1e3 * columns["cop_x_m"], atol=1e-3)
    np.testing.assert_allclose(cop_mm[:, 1], 1e3 * columns["cop_y_m"], atol=1e-3)


def test_forces_of_one_row_of_tiles_act_at_the_row(plain: Read) -> None:
    read = Read(export_of_walk(row_walk(), info=ROW))
    stated = np.isfinite(walk()["cop_x_m"])
    corners = np.reshape(read.reader.get("FORCE_PLATFORM:CORNERS").float_array, (4, 3))
    assert corners[:, 1].mean() == pytest.approx(10.0)
    np.testing.assert_array_equal(read.channel("Mx1")[stated], 0.0)
    np.testing.assert_array_equal(read.channel("My1"), plain.channel("My1"))
    np.testing.assert_array_equal(np.isnan(read.channel("Mx1")), np.isnan(plain.channel("Mx1")))
    said = " ".join(text.strip() for text in read.reader.get("FOOTTILE:ROW").string_array)
    assert said.startswith("COP not measured along y: tiles in one row; points are at y = 10 mm")
    assert "FOOTTILE:ROW" not in plain.reader


def test_the_platform_is_the_rectangle_of_the_loaded_tiles(plain: Read) -> None:
    corners = np.reshape(plain.reader.get("FORCE_PLATFORM:CORNERS").float_array, (4, 3))
    expected = [[40, -20, -150], [-20, -20, -150], [-20, 20, -150], [40, 20, -150]]
    np.testing.assert_allclose(corners, expected, atol=1e-4)
    assert "force_n_3" in plain.labels
    assert "force_n_4" not in plain.labels


def test_what_has_to_be_an_integer_is_one(plain: Read) -> None:
    integers = {
        "FORCE_PLATFORM": {"USED", "TYPE", "ZERO", "CHANNEL"},
        "EVENT": {"USED"},
        "ANALOG": {"USED", "OFFSET"},
        "POINT": {"USED", "FRAMES", "DATA_START"},
    }
    for group, names in integers.items():
        for name in names:
            assert plain.reader.get(f"{group}:{name}").bytes_per_element == 2, name
    for name in ("FORCE_PLATFORM:CORNERS", "FORCE_PLATFORM:ORIGIN", "ANALOG:RATE", "POINT:RATE"):
        assert plain.reader.get(name).bytes_per_element == 4, name


def test_tiles_estimates_and_flags_are_channels_with_their_units(plain: Read) -> None:
    columns = walk()
    for name in ("grf_n", "grf_sigma_n", "grf_lower_bound_n", "contact", "estimate_flags"):
        np.testing.assert_array_equal(plain.channel(name), np.float32(columns[name]))
    for i in range(4):
        forces_n = np.float32(columns["force_n"][:, i])
        np.testing.assert_array_equal(plain.channel(f"force_n_{i}"), forces_n)
    units = dict(zip(plain.labels, plain.texts("ANALOG:UNITS"), strict=True))
    assert units["Fz1"] == units["force_n_0"] == "N"
    assert units["Mx1"] == "Nmm"
    assert plain.reader.get("ANALOG:RATE").float_value == RATE_HZ
    said = dict(zip(plain.labels, plain.texts("ANALOG:DESCRIPTIONS"), strict=True))
    assert said["force_n_2"] == "force along its axis on tile T03 at -10, 10, -150 mm"


def test_contacts_are_events_of_their_usual_names(plain: Read) -> None:
    expected = [
        (label, row / RATE_HZ)
        for stance in STANCES
        for label, row in zip(LABELS, stance, strict=True)
    ]
    assert [label for label, _ in plain.events()] == [label for label, _ in expected]
    np.testing.assert_allclose([t for _, t in plain.events()], [t for _, t in expected], atol=1e-6)


def test_a_contact_that_begins_in_slots_without_frames_is_no_event() -> None:
    kept = np.delete(np.arange(ROWS), np.arange(95, 105))
    columns = {name: values[kept] for name, values in walk().items()}
    read = Read(export_of_walk(columns, times={"t_mono_ns": PERIOD_NS * kept}))
    assert [label for label, _ in read.events()] == ["Foot Off", "Foot Strike", "Foot Off"]


def test_an_unknown_contact_is_nan_and_no_number() -> None:
    columns = walk()
    columns["contact"][:50] = CONTACT_UNKNOWN
    read = Read(export_of_walk(columns))
    expected = np.where(columns["contact"] == CONTACT_UNKNOWN, np.nan, columns["contact"])
    np.testing.assert_array_equal(read.channel("contact"), expected)


LABELS = ("Foot Strike", "Foot Off")


def markers(labels: dict[int, str]) -> PlacedMarkers:
    return PlacedMarkers(
        [
            PlacedMarker(Marker(id=str(row), label=text, t_ns=0), (0, row), 0, 0)
            for row, text in labels.items()
        ]
    )


def test_marks_are_events_in_letters_that_every_reader_knows() -> None:
    found = Read(export_of_walk(markers=markers({3: "Stoß «links» 😀", 7: "=1+1", 9: "x" * 400})))
    labels = [label for label, _ in found.events()][:3]
    assert labels == ["StoU+00DF U+00ABlinksU+00BB U+1F600", "=1+1", "x" * 100]
    assert found.events()[0][1] == pytest.approx(3 / RATE_HZ)


def test_of_too_many_events_marks_come_first() -> None:
    columns = walk()
    columns["contact"] = np.tile(np.array([0, 1], dtype=np.uint8), ROWS // 2)
    found = Read(export_of_walk(columns, markers=markers({500: "here"})))
    assert len(found.events()) == 255
    assert found.events()[0][0] == "here"
    assert "1 markers, 999 begins and ends of contact; the last 745 are left out" in found.text(
        "EVENTS"
    )


def test_a_saturated_tile_leaves_no_force_but_its_bound() -> None:
    found = Read(export_of_walk(saturated(walk(), slice(200, 250))))
    for name in ("Fz1", "Mx1", "My1", "Fx1", "grf_n"):
        assert np.isnan(found.channel(name)[200:250]).all(), name
        assert np.isfinite(found.channel(name)[150:200]).all(), name
    assert np.isfinite(found.channel("grf_lower_bound_n")).all()
    assert (found.channel("estimate_flags")[200:250].astype(int) & 1).all()


def test_lost_frames_are_empty_samples() -> None:
    kept = np.delete(np.arange(ROWS), np.arange(600, 640))
    lost = [{"lost": {"disk_full": 40}}]
    ledger = {"complete": True, "lossy": True, "parts": lost, "missed_slots": 3}
    found = Read(export_of_walk(keep=kept, notes={"ledger": ledger}))
    assert np.isnan(found.analog[:, 600:640]).all()
    np.testing.assert_array_equal(found.channel("Fz1")[700], np.float32(-walk()["grf_n"][700]))
    said = "lossy: 40 disk_full; 3 slots in which no frame was taken"
    assert found.text("COMPLETE") == said
    assert "40 samples are empty" in found.text("RESAMPLED")


def test_a_file_says_what_it_is_of(plain: Read) -> None:
    source = {"session": "20260101-000000-abc", "content_sha256": "f" * 64}
    whole = {"complete": True, "lossy": False, "parts": [{"lost": {}}]}
    found = Read(export_of_walk(provenance=source, notes={"ledger": whole}, part=Slice(0.2, 0.4)))
    assert found.text("SESSION") == "20260101-000000-abc"
    assert found.text("COMPLETE") == "complete"
    assert found.text("SLICE") == "0.2 s to 0.4 s"
    assert found.text("BEGIN_T_NS") == str(10**18 + 200_000_000)
    assert found.text("BEGIN_UTC") == "2001-09-09T01:46:40.200000000Z by the node's clock"
    assert found.analog.shape[1] == 100
    assert "x forward, y to the left" in plain.text("AXES")


def test_long_sessions_have_several_samples_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(written_c3d, "C3D_FRAMES_MAX", 99)
    found = Read(export_of_walk())
    assert found.reader.header.analog_per_frame == 11
    assert found.reader.header.last_frame == 91
    np.testing.assert_array_equal(found.channel("grf_n")[:ROWS], np.float32(walk()["grf_n"]))
    assert found.analog.shape[1] == 1001
    assert np.isnan(found.analog[:, 1000:]).all()
    assert "at the end 1 samples, NaN, fill the last frame" in found.text("FILLED")


def test_read_as_a_reference_a_session_gives_its_force_and_cop(tmp_path: Path) -> None:
    path = tmp_path / "own.c3d"
    path.write_bytes(b"".join(C3D.encode(export_of_walk())))
    found, columns = read_reference(path, ReferenceOptions()), walk()
    np.testing.assert_allclose(found.time_s, np.arange(ROWS) / RATE_HZ, atol=1e-6)
    on = columns["contact"] == 1
    np.testing.assert_allclose(found.grf_n, on * columns["grf_n"], atol=1e-5)
    assert found.cop_m is not None
    own_m = np.stack([columns["cop_x_m"], columns["cop_y_m"]], axis=1)
    np.testing.assert_allclose(found.cop_m, own_m, atol=1e-6)
    assert "the reaction on the foot" in found.notes[0]


def test_a_slice_in_a_gap_is_refused() -> None:
    kept = np.delete(np.arange(ROWS), np.arange(600, 640))
    with pytest.raises(UsageError, match="no frame is in this slice"):
        list(C3D.encode(export_of_walk(keep=kept, part=Slice(1.21, 1.27))))


def test_a_full_disk_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    save = written_c3d._save
    monkeypatch.setattr(written_c3d, "_save", lambda _, *rest: save(Path("/dev/full"), *rest))
    with pytest.raises(StorageError, match="cannot be written"):
        list(C3D.encode(export_of_walk()))


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RuntimeError("please open a GitHub issue"), "ezc3d cannot write it"),
        (ValueError("please open a GitHub issue"), "ezc3d cannot write it"),
        (MemoryError("std::bad_alloc"), "not enough memory"),
    ],
)
def test_messages_of_the_library_are_not_passed_on(
    monkeypatch: pytest.MonkeyPatch, error: Exception, said: str
) -> None:
    def refuse(*_: object) -> None:
        raise error

    monkeypatch.setattr("ezc3d.c3d.write", refuse)
    with pytest.raises(StorageError, match=said) as caught:
        list(C3D.encode(export_of_walk()))
    assert str(error) not in str(caught.value)


def test_names_are_written_in_ascii() -> None:
    tile = ARRAY.tiles[0].model_copy(update={"serial": "T'é\"/😀"})
    info = ARRAY.model_copy(update={"tiles": (tile, *ARRAY.tiles[1:]), "node": "l/é"})
    found = Read(export_of_walk(info=info))
    assert found.text("NODE") == "l/e"
    assert escape_control_chars(
        found.texts("ANALOG:DESCRIPTIONS")[found.labels.index("force_n_0")]
    ).startswith("force along its axis on tile T'e\"/U+1F600")


# --- several sessions -----------------------------------------------------------------------------


def test_two_feet_are_two_platforms_on_the_servers_axis() -> None:
    found = Read(two_feet(markers=markers({10: "tap"})))
    late = round(LATE_NS * 1e-9 * RATE_HZ)
    fz = np.float32(np.where(walk()["contact"] == 1, walk()["grf_n"], 0.0))
    assert found.analog.shape[1] == ROWS + late
    np.testing.assert_allclose(found.channel("Fz1")[:ROWS], -fz, atol=1e-4)
    np.testing.assert_allclose(found.channel("Fz2")[late:], -fz, atol=1e-4)
    assert np.isnan(found.channel("Fz1")[ROWS:]).all()
    assert np.isnan(found.channel("Fz2")[:late]).all()
    assert "1:force_n_0" in found.labels
    assert "2:contact" in found.labels
    channels = np.ravel(found.reader.get("FORCE_PLATFORM:CHANNEL").int16_array)
    assert [found.labels[i - 1] for i in channels] == [
        f"{name}{number}" for number in (1, 2) for name in ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    ]


def test_an_event_says_which_foot_it_is_of() -> None:
    found = Read(two_feet(markers=markers({10: "tap"})))
    named = list(zip(found.texts("EVENT:CONTEXTS"), found.events(), strict=True))
    taps = [(context, label) for context, (label, _) in named[:2]]
    assert taps == [("Left", "tap"), ("right-2", "tap")]
    strikes = [(context, at_s) for context, (label, at_s) in named if label == "Foot Strike"]
    expected = [("Left", 0.2), ("right-2", 0.5), ("Left", 1.0), ("right-2", 1.3)]
    assert [context for context, _ in strikes] == [context for context, _ in expected]
    np.testing.assert_allclose([t for _, t in strikes], [t for _, t in expected], atol=1e-3)

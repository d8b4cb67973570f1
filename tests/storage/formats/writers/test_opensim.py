"""OpenSim: loads that OpenSim itself computes with, and what was filled for its sake."""

from __future__ import annotations

import io
import math
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv as pacsv
import pytest
from pydantic import ValidationError

from devices.errors import UsageError
from storage.formats.markers import PlacedMarker, PlacedMarkers
from storage.formats.slice import FormatOptions
from storage.formats.writers.opensim import LOAD_COLUMNS, OPENSIM
from storage.schema import Array
from storage.sessions.folder import Marker
from tests.builders.arrays import make_array
from tests.storage.formats.walks import (
    ARRAY,
    RATE_HZ,
    ROW,
    ROWS,
    STANCES,
    export_of_walk,
    lines_of_documents,
    row_walk,
    two_feet,
    walk,
)
from tests.storage.formats.writers.unpacked import Unpacked

GRAVITY = 9.80665
"""Of OpenSim's models, m/s2."""


def on_the_ground() -> dict[str, Array]:
    """A walk of a foot whose servo and ankle's travel are known."""
    columns = walk()
    ground = {"cop_ground_x_m": columns["cop_x_m"] + 0.1, "cop_ground_y_m": columns["cop_y_m"]}
    return {**columns, **ground}


@pytest.fixture
def ground(tmp_path: Path) -> Unpacked:
    return Unpacked(export_of_walk(on_the_ground()), tmp_path)


def test_the_header_says_how_much_there_is(ground: Unpacked) -> None:
    counts = [f"nRows={ROWS}", f"nColumns={1 + len(LOAD_COLUMNS)}"]
    assert ground.head[:-1] == ["session", "version=1", *counts, "inDegrees=no"]
    assert ground.head[-1].startswith("gaps=0 gaps of the force are straight lines (limit 50 ms")
    assert ground.table.shape == (ROWS, 1 + len(LOAD_COLUMNS))
    np.testing.assert_allclose(ground.columns["time"], np.arange(ROWS) / RATE_HZ, atol=1e-9)


def test_the_force_is_upwards_at_the_cop(ground: Unpacked) -> None:
    columns = on_the_ground()
    on, stated = columns["contact"] == 1, np.isfinite(columns["cop_x_m"])
    force_n, x_m, z_m = (ground.columns[f"ground_force_{name}"] for name in ("vy", "px", "pz"))
    np.testing.assert_allclose(force_n, np.where(on, columns["grf_n"], 0.0), atol=1e-6)
    np.testing.assert_allclose(x_m[stated], columns["cop_ground_x_m"][stated], atol=1e-6)
    np.testing.assert_allclose(z_m[stated], -columns["cop_ground_y_m"][stated], atol=1e-6)
    for name in ("vx", "vz", "py"):
        np.testing.assert_array_equal(ground.columns[f"ground_force_{name}"], 0.0)
    assert (
        ground.tag("force_expressed_in_body") == ground.tag("point_expressed_in_body") == "ground"
    )


@pytest.mark.parametrize("frame", ["ground", "foot"])
def test_of_tiles_in_one_row_points_are_at_the_row(frame: str, tmp_path: Path) -> None:
    columns = row_walk()
    if frame == "ground":
        columns["cop_ground_x_m"] = columns["cop_x_m"] + 0.1
        columns["cop_ground_y_m"] = np.full(ROWS, np.nan)
    found = Unpacked(export_of_walk(columns, info=ROW), tmp_path)
    assert found.tag("point_expressed_in_body") == frame
    stated = np.isfinite(columns["cop_x_m"])
    ahead_m = 0.1 if frame == "ground" else 0.0
    np.testing.assert_allclose(
        found.columns["ground_force_px"][stated], columns["cop_x_m"][stated] + ahead_m, atol=1e-6
    )
    np.testing.assert_allclose(found.columns["ground_force_pz"], -0.01, atol=1e-9)
    assert "y = 10 mm" in found.notes["ROW"]
    assert found.notes["FILLED_ROWS"] == {"no contact": 300, "no centre of pressure stated": 4}


def test_tiles_side_by_side_have_points_in_the_frame_of_the_foot(tmp_path: Path) -> None:
    info = make_array(ARRAY.tiles[:2])  # both at x = 30 mm
    columns = walk()
    columns |= {
        "cop_x_m": np.full(ROWS, np.nan),
        "cop_ground_x_m": np.full(ROWS, np.nan),
        "cop_ground_y_m": columns["cop_y_m"],
        "force_n": columns["force_n"][:, :2],
    }
    found = Unpacked(export_of_walk(columns, info=info), tmp_path)
    assert found.tag("point_expressed_in_body") == "foot"
    np.testing.assert_allclose(found.columns["ground_force_px"], 0.03, atol=1e-9)
    np.testing.assert_allclose(found.columns["ground_force_pz"], -0.004, atol=1e-9)


def test_all_cells_are_numbers_and_filled_rows_are_listed(ground: Unpacked) -> None:
    assert np.isfinite(ground.table).all()
    time_s, columns = ground.columns["time"], on_the_ground()
    listed = np.zeros(ROWS, dtype=bool)
    for row in ground.filled:
        listed |= (time_s >= row["from_s"]) & (time_s <= row["to_s"])
    untouched = (columns["contact"] == 1) & np.isfinite(columns["cop_x_m"])
    np.testing.assert_array_equal(listed, ~untouched)
    reasons = {row["because"] for row in ground.filled}
    assert reasons == {"no contact", "no centre of pressure stated"}
    assert ground.notes["FILLED_ROWS"] == {"no contact": 300, "no centre of pressure stated": 4}


def test_a_foot_without_a_servo_is_a_body_of_the_model(tmp_path: Path) -> None:
    options = FormatOptions(body="calcn_r")
    found = Unpacked(export_of_walk(options=options), tmp_path)
    for name in ("applied_to_body", "force_expressed_in_body", "point_expressed_in_body"):
        assert found.tag(name) == "calcn_r"
    np.testing.assert_allclose(found.columns["ground_force_py"], -0.15)
    stated = np.isfinite(walk()["cop_x_m"])
    x_m = found.columns["ground_force_px"][stated]
    np.testing.assert_allclose(x_m, walk()["cop_x_m"][stated], atol=1e-6)
    assert "the foot's own frame" in found.notes["AXES"]


def test_marks_and_contacts_lie_beside_it(tmp_path: Path) -> None:
    event = Marker(id="1", label="=HYPERLINK(1)", t_ns=0)
    found = Unpacked(
        export_of_walk(markers=PlacedMarkers([PlacedMarker(event, (0, 3), 0, 0)])), tmp_path
    )
    events = pacsv.read_csv(next(tmp_path.glob("*_events.csv"))).to_pylist()
    assert events[0] == {"time": 3 / RATE_HZ, "event": "'=HYPERLINK(1)", "kind": "marker"}
    rows = [round(row["time"] * RATE_HZ) for row in events[1:]]
    assert rows == [row for stance in STANCES for row in stance]
    assert found.notes["MARKS"] == 1


@pytest.mark.parametrize(
    ("session", "stem"), [("20260101-000000-abc",) * 2, ("../../é/x", ".._.._e_x")]
)
def test_files_have_the_sessions_name_and_stay_in_the_folder(session: str, stem: str) -> None:
    content = b"".join(OPENSIM.encode(export_of_walk(provenance={"session": session})))
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        assert {name.removeprefix(stem) for name in file.namelist()} == {
            *(".mot", ".xml", "_filled.csv", "_events.csv", "_notes.json")
        }


@pytest.mark.parametrize("name", ["", "a b", "a/b", "<b>", "a\x00", "x" * 101])
def test_what_is_no_name_of_a_body_is_refused(name: str) -> None:
    with pytest.raises(ValidationError):
        FormatOptions(body=name)


def test_forces_without_any_point_are_refused() -> None:
    columns = walk()
    columns["cop_x_m"][:] = np.nan
    with pytest.raises(UsageError, match="no centre of pressure is stated in it"):
        list(OPENSIM.encode(export_of_walk(columns)))


# --- OpenSim itself -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def opensim() -> Any:
    found = pytest.importorskip(
        "opensim", reason="OpenSim is not installed: pip install 'foottile[opensim]' (72 MB)"
    )
    found.Logger.removeFileSink()  # else it leaves opensim.log wherever it is started
    return found


MASS_KG = 1.0


def free_feet(opensim: Any, folder: Path, *bodies: str) -> Path:
    """A model of these bodies, each free in the ground, its origin at it."""
    model = opensim.Model()
    for name in bodies:
        body = opensim.Body(name, MASS_KG, opensim.Vec3(0), opensim.Inertia(0.01, 0.01, 0.01))
        model.addBody(body)
        model.addJoint(opensim.FreeJoint(f"free_{name}", model.getGround(), body))
    model.finalizeConnections()
    model.printToXML(str(folder / "feet.osim"))
    coordinates = model.getCoordinateSet()
    names = [coordinates.get(i).getName() for i in range(coordinates.getSize())]
    rows = "".join(f"{i * 0.01:.2f}" + "\t0" * len(names) + "\n" for i in range(201))
    head = f"still\nversion=1\nnRows=201\nnColumns={1 + len(names)}\ninDegrees=no\nendheader\n"
    (folder / "still.mot").write_text(head + "\t".join(["time", *names]) + "\n" + rows)
    return folder / "feet.osim"


def inverse_dynamics(opensim: Any, folder: Path, *bodies: str) -> tuple[Array, list[Array]]:
    """Times, and what holds each foot still under these loads: moments and forces, (n, 6)."""
    tool = opensim.InverseDynamicsTool()
    tool.setModelFileName(str(free_feet(opensim, folder, *bodies)))
    tool.setCoordinatesFileName(str(folder / "still.mot"))
    tool.setExternalLoadsFileName(str(next(folder.glob("*.xml"))))
    tool.setStartTime(0.3)
    tool.setEndTime(1.7)
    tool.setResultsDir(str(folder))
    tool.setOutputGenForceFileName("held.sto")
    assert tool.run()
    table = opensim.TimeSeriesTable(str(folder / "held.sto"))
    columns = [table.getDependentColumn(label).to_numpy() for label in table.getColumnLabels()]
    held = np.stack(columns, axis=1)
    return np.array(table.getIndependentColumn()), np.split(held, len(bodies), axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("columns", [on_the_ground(), walk()], ids=["ground", "foot"])
def test_opensim_computes_what_the_loads_do_to_a_foot(
    opensim: Any, tmp_path: Path, columns: dict[str, Array]
) -> None:
    found = Unpacked(export_of_walk(columns), tmp_path)
    read = opensim.TimeSeriesTable(str(found.mot))
    assert read.getNumRows() == ROWS
    assert tuple(read.getColumnLabels()) == LOAD_COLUMNS
    time_s, (held,) = inverse_dynamics(opensim, found.folder, "foot")
    force_n, x_m, y_m, z_m = (
        np.interp(time_s, found.columns["time"], found.columns[f"ground_force_{name}"])
        for name in ("vy", "px", "py", "pz")
    )
    # What holds it bears its weight less the ground's force, and that one's moment.
    np.testing.assert_allclose(held[:, 4], MASS_KG * GRAVITY - force_n, atol=0.02)
    np.testing.assert_allclose(held[:, 2], -x_m * force_n, atol=2e-3)
    np.testing.assert_allclose(held[:, 0], z_m * force_n, atol=2e-3)
    assert not math.isclose(float(np.ptp(held[:, 4])), 0.0)
    assert np.isfinite(y_m).all()


@pytest.mark.slow
def test_opensim_presses_each_foot_of_a_take_with_its_own_force(
    opensim: Any, tmp_path: Path
) -> None:
    options = FormatOptions(body="calcn_l,calcn_r")
    content = OPENSIM.encode_together_on_server_clock(
        [replace(e, options=options) for e in two_feet()]
    )
    with zipfile.ZipFile(io.BytesIO(b"".join(content))) as file:
        file.extractall(tmp_path)
    mot = opensim.TimeSeriesTable(str(next(tmp_path.glob("*.mot"))))
    time_s, feet = inverse_dynamics(opensim, tmp_path, "calcn_l", "calcn_r")
    for held, node in zip(feet, ("left", "right-2"), strict=True):
        read = mot.getDependentColumn(f"{node}_ground_force_vy").to_numpy()
        force_n = np.interp(time_s, np.array(mot.getIndependentColumn()), read)
        assert force_n.max() > 1.0
        np.testing.assert_allclose(held[:, 4], MASS_KG * GRAVITY - force_n, atol=0.02)


@pytest.mark.slow
def test_the_lines_in_the_documents_compute_torques(
    opensim: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Unpacked(export_of_walk(on_the_ground(), provenance={"session": "ID"}), tmp_path)
    free_feet(opensim, tmp_path, "foot").rename(tmp_path / "leg.osim")
    (tmp_path / "still.mot").rename(tmp_path / "leg.mot")
    monkeypatch.chdir(tmp_path)
    exec(lines_of_documents("OpenSim"), {})  # noqa: S102  # our own
    assert opensim.TimeSeriesTable(str(tmp_path / "torques.sto")).getNumColumns() == 6

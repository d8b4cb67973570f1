"""Plates of any kind and place against arithmetic of this test, on the channels as stored.

C3D stores single precision, so the arithmetic begins with the stored numbers. It works in the
laboratory: the wrench is carried there, and the centre of pressure is the point of the surface
about which the moment is along the normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from devices.arrays import Floats
from storage.formats.reference import ReferenceOptions, read_reference
from storage.formats.writers.c3d import C3D
from storage.schema import Array
from tests.builders.arrays import make_array, make_tile
from tests.storage.formats.walks import export_of_walk, walk
from tests.storage.formats.writers.readers import C3dFile

ezc3d = pytest.importorskip("ezc3d")
pytest.importorskip("c3d")

SAMPLES = 60
LOAD_N = 400.0 * np.sin(np.linspace(0.05, np.pi - 0.05, SAMPLES))
UNITS = {1: (3, 2, 1), 2: (3, 0, 3), 3: (8, 0, 0), 4: (3, 0, 3)}
"""Channels of forces, of places and of moments, by type."""
COLUMNS = {"grf_n": "plate1_fz", "cop_x_m": "plate1_cop_x", "cop_y_m": "plate1_cop_y"}
LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


@dataclass(frozen=True)
class Plate:
    """A plate as a file states it, in the unit of its positions.

    Attributes:
        kind: type of the C3D manual.
        corners: (4, 3).
        origin: (3,), from its origin to the middle of its surface, in its own axes.
        channels: (channels, n), as stored.
        matrix: of type 4.
        lever: unit of moments in that of positions.
    """

    kind: int
    corners: Floats
    origin: Floats
    channels: Floats
    matrix: Floats | None
    lever: float = 1.0


def single(values: Any) -> Floats:
    """Return numbers as C3D stores them."""
    return np.asarray(values, dtype=np.float32).astype(np.float64)


def axes_of(corners: Floats) -> Floats:
    """Return the plate's axes in the laboratory, as columns."""
    x = (corners[0] - corners[1]) + (corners[3] - corners[2])
    z = np.cross(x, (corners[0] - corners[3]) + (corners[1] - corners[2]))
    y = np.cross(z, x)
    return np.stack([axis / np.linalg.norm(axis) for axis in (x, y, z)], axis=1)


def wrench_of(plate: Plate) -> tuple[Floats, Floats]:
    """Return force and moment about the middle of the surface, (3, n) each, in the plate's axes."""
    c, (a, b, h) = plate.channels, plate.origin
    if plate.kind == 1:
        place = np.stack([c[3], c[4], np.zeros(SAMPLES)])
        return c[:3], np.cross(place, c[:3], axis=0)
    if plate.kind == 3:
        sensors = np.array([(a, b, 0.0), (-a, b, 0.0), (-a, -b, 0.0), (a, -b, 0.0)])
        up = np.array([0.0, 0.0, 1.0])
        moment = sum(np.outer(np.cross(s, up), fz) for s, fz in zip(sensors, c[4:], strict=True))
        force = np.stack([c[0] + c[1], c[2] + c[3], c[4] + c[5] + c[6] + c[7]])
        return force, moment - np.cross([0.0, 0.0, h], force, axisb=0, axisc=0)
    if plate.matrix is not None:
        c = plate.matrix @ c
    force, moment = c[:3], c[3:] * plate.lever
    return force, moment - np.cross(plate.origin, force, axisb=0, axisc=0)


def force_and_place(plate: Plate) -> tuple[Floats, Floats]:
    """Return the force along the normal and the centre of pressure in the laboratory, (3, n)."""
    axes, middle = axes_of(plate.corners), plate.corners.mean(axis=0)
    force, moment = (axes @ part for part in wrench_of(plate))
    normal = axes[:, 2]
    along = normal @ force
    # n x (M - r x F) = 0 and r in the surface: r = n x M / (n F).
    return along, middle[:, None] + np.cross(normal, moment, axisb=0, axisc=0) / along


def in_plane(place: Floats, up: Floats) -> Floats:
    """Return x and y of a place, the laboratory turned until the plate's normal is its z.

    A plate whose corners run the other way round does not hang from the ceiling.
    """
    if np.argmax(np.abs(up)) == 2:
        up = up * np.sign(up[2])
    axis = np.zeros(3)
    axis[np.argmax(np.abs(up))] = np.sign(up[np.argmax(np.abs(up))])
    return np.asarray(turn(axis, np.array([0.0, 0.0, 1.0])) @ turn(up, axis) @ place)[:2]


def turn(begin: Floats, end: Floats) -> Floats:
    """Return the rotation by the smallest angle."""
    cross = np.cross(begin, end)
    angle = np.arctan2(np.linalg.norm(cross), begin @ end)
    size = np.linalg.norm(cross)
    vector = cross * angle / size if size > 0.0 else cross
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


@st.composite
def plates(draw: st.DrawFn) -> tuple[Plate, str, str]:
    """Draw a plate with its units of positions and moments."""
    kind = draw(st.sampled_from([1, 2, 3, 4]))
    sign = draw(st.sampled_from([1.0, -1.0]))
    unit, moments = draw(st.sampled_from([("mm", "Nmm"), ("m", "Nm"), ("mm", "Nm"), ("cm", "Ncm")]))
    if kind == 4:
        moments = f"N{unit}"  # its matrix makes moments in the unit of positions
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    upright = draw(st.sampled_from(["flat", "tilted", "anywhere"]))
    sizes = rng.uniform(0.2, 0.6, 2) / LENGTHS[unit]
    where = Rotation.random(random_state=draw(st.integers(0, 10_000)))
    if upright != "anywhere":
        level = turn(
            np.array([0.0, 0.0, -1.0]),
            draw(st.sampled_from([*np.eye(3)[:2], *-np.eye(3)[:2], np.eye(3)[2]])),
        )
        tilt = 0.0 if upright == "flat" else rng.uniform(0.1, 0.6)
        about = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0.0, 6.3)])
        where = Rotation.from_matrix(level) * Rotation.from_rotvec([tilt, 0.0, 0.0]) * about
    signs = np.array([(1, 1, 0), (-1, 1, 0), (-1, -1, 0), (1, -1, 0)])
    corners = where.apply(0.5 * signs * [*sizes, 0.0]) + rng.uniform(-3.0, 3.0, 3) / LENGTHS[unit]
    corners = single(corners)
    places = np.stack([s * rng.uniform(-0.45, 0.45, SAMPLES) for s in sizes] + [np.zeros(SAMPLES)])
    force = sign * np.stack([0.1 * LOAD_N, -0.2 * LOAD_N, LOAD_N])
    height = draw(st.sampled_from([-1.0, 0.0])) * 0.04 / LENGTHS[unit]
    origin = single([0.01 / LENGTHS[unit], -0.005 / LENGTHS[unit], height])
    if kind == 3:
        origin = single([0.4 * sizes[0], 0.4 * sizes[1], height])
    lever = LENGTHS[moments.removeprefix("N")] / LENGTHS[unit]
    matrix = None
    if kind == 1:
        rows = [*force, *places[:2], 0.01 * LOAD_N]
    elif kind == 3:
        moment = np.cross(places + np.array([[0.0], [0.0], [height]]), force, axis=0)
        a, b = origin[:2]
        sums = np.array([[1, 1, 1, 1], [b, b, -b, -b], [-a, a, a, -a], [1, -1, 1, -1]])
        verticals = np.linalg.solve(sums, np.stack([force[2], moment[0], moment[1], 0.1 * LOAD_N]))
        rows = [0.3 * force[0], 0.7 * force[0], 0.4 * force[1], 0.6 * force[1], *verticals]
    else:
        moment = np.cross(places + origin[:, None], force, axis=0) / lever
        rows = [*force, *moment]
        if kind == 4:
            matrix = single(np.eye(6) + 0.1 * rng.normal(size=(6, 6)))
            rows = [*np.linalg.solve(matrix, np.stack(rows))]
    return Plate(kind, corners, origin, single(np.stack(rows)), matrix, lever), unit, moments


def save(path: Path, plate: Plate, unit: str, moments: str, *, raised: bool) -> None:
    """Write a plate by ezc3d."""
    file = ezc3d.c3d()
    forces, places, levers = UNITS[plate.kind]
    origin = plate.origin.copy()
    if raised:
        origin *= [1.0, 1.0, -1.0] if plate.kind == 3 else -1.0
    matrix = np.zeros((6, 6)) if plate.matrix is None else plate.matrix
    count = len(plate.channels)
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    analog = file["parameters"]["ANALOG"]
    analog["RATE"]["value"] = [1000.0]
    analog["LABELS"]["value"] = [f"c{i}" for i in range(count)]
    analog["UNITS"]["value"] = ["N"] * forces + [unit] * places + [moments] * levers
    platform: dict[str, Any] = {
        "USED": np.array([1]),
        "TYPE": np.array([plate.kind]),
        "ZERO": np.array([1, 0]),
        "CORNERS": plate.corners.T[:, :, None],
        "ORIGIN": origin[:, None],
        "CHANNEL": np.arange(1, count + 1)[:, None],
        "CAL_MATRIX": matrix[:, :, None],
    }
    file.add_parameter("FORCE_PLATFORM", "USED", [1])
    for name, value in platform.items():
        kind = ezc3d.ezc3d.INT if value.dtype.kind == "i" else ezc3d.ezc3d.FLOAT
        about = {"type": kind, "description": "", "is_locked": False, "value": value}
        file["parameters"]["FORCE_PLATFORM"][name] = about
    file["data"]["points"] = np.zeros((4, 0, SAMPLES // 10))
    file["data"]["analogs"] = plate.channels[None]
    file.write(str(path))


@settings(max_examples=80)
@given(drawn=plates(), raised=st.booleans())
def test_any_plate_that_ezc3d_writes_is_read_as_its_channels_are(
    tmp_path_factory: pytest.TempPathFactory, drawn: tuple[Plate, str, str], raised: bool
) -> None:
    plate, unit, moments = drawn
    raised = raised and plate.origin[2] < 0.0  # from the surface to the origin, as some store it
    path = tmp_path_factory.mktemp("plate") / "gait.c3d"
    save(path, plate, unit, moments, raised=raised)
    np.testing.assert_array_equal(ezc3d.c3d(str(path))["data"]["analogs"][0], plate.channels)
    stated = ReferenceOptions(COLUMNS, {"grf": "N", "cop": unit} if plate.kind == 4 else {})
    found = read_reference(path, stated)
    along, place = force_and_place(plate)
    np.testing.assert_allclose(found.grf_n, np.abs(along), rtol=1e-9)
    expected = LENGTHS[unit] * in_plane(place, -axes_of(plate.corners)[:, 2])
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m.T, expected, rtol=0.0, atol=1e-9)
    holds = "the load on the plate" if along.mean() > 0.0 else "the reaction on the foot"
    assert any(holds in note for note in found.notes)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_any_foot_that_our_writer_writes_is_read_as_its_channels_are(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """Our writer states type 2, the reaction on the foot, and a level plate of any size."""
    rng = np.random.default_rng(seed)
    tiles = [
        make_tile(i, x_m=x, y_m=y, z_m=rng.uniform(-0.2, 0.0))
        for i, (x, y) in enumerate(rng.uniform(-0.1, 0.1, (5, 2)))
    ]
    columns: dict[str, Array] = walk()
    on = np.isfinite(columns["cop_x_m"])
    columns["grf_n"] *= rng.uniform(0.1, 30.0)
    for axis in "xy":
        columns[f"cop_{axis}_m"][on] = rng.uniform(-0.1, 0.1, int(on.sum()))
    path = tmp_path_factory.mktemp("foot") / "own.c3d"
    path.write_bytes(b"".join(C3D.encode(export_of_walk(columns, info=make_array(tiles)))))
    file = C3dFile(path.read_bytes())
    corners = np.reshape(file.reader.get("FORCE_PLATFORM:CORNERS").float_array, (4, 3))
    names = ("Fx1", "Fy1", "Fz1", "Mx1", "My1", "Mz1")
    channels = np.stack([file.channel(name) for name in names]).astype(np.float64)
    plate = Plate(2, corners.astype(np.float64), np.zeros(3), channels, None)
    with np.errstate(divide="ignore", invalid="ignore"):
        along, place = force_and_place(plate)
    found = read_reference(path, ReferenceOptions())
    np.testing.assert_allclose(found.grf_n, -along, rtol=1e-9)
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m.T, 1e-3 * place[:2], rtol=0.0, atol=1e-9)
    assert (np.isfinite(found.cop_m[:, 0]) == on).all()

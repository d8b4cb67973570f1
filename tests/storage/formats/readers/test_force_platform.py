"""Force platforms of C3D files that are written byte by byte: what is read, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from devices.arrays import Floats
from devices.errors import FileFormatError, UsageError
from storage.formats.readers.c3d import C3dFile
from storage.formats.reference import ReferenceData, ReferenceOptions, read_reference
from tests.builders.c3d import c3d_bytes, force_plate, two_plates
from tests.storage.formats.readers.reading import check, read_c3d

LOAD_N = np.linspace(0.0, 98.0, 50)
X_MM, Y_MM = 10.0, 20.0
"""Of the load, in the plate's own axes, of which y and z are turned in the laboratory's."""


def on_sensors(force_n: Any, right: Any, front: Any) -> list[Floats]:
    """Forces on four sensors of a load so far from the middle, as parts of their distances."""
    right, front = 0.5 + right, 0.5 + front
    parts = [right * front, (1 - right) * front, (1 - right) * (1 - front), right * (1 - front)]
    return [part * force_n for part in parts]


def channels(kind: int) -> Floats:
    """What a plate of this type measures of `LOAD_N` at (`X_MM`, `Y_MM`) on its surface."""
    nothing = np.zeros(50)
    if kind == 1:  # forces, the centre of pressure itself, free moment
        return np.stack([nothing, nothing, LOAD_N, nothing + X_MM, nothing + Y_MM, nothing], axis=1)
    if kind == 3:  # x12, x34, y14, y23, then z1 to z4 at four corners of 200 by 100 mm
        return np.stack([*[nothing] * 4, *on_sensors(LOAD_N, X_MM / 200.0, Y_MM / 100.0)], axis=1)
    return np.stack([nothing, nothing, LOAD_N, Y_MM * LOAD_N, -X_MM * LOAD_N, nothing], axis=1)


MORE: dict[int, dict[str, Any]] = {
    1: {},
    2: {},
    3: {"ORIGIN": np.array([[100.0, 50.0, -40.0]])},
    4: {"CAL_MATRIX": np.eye(6).reshape(1, 6, 6)},
}


COLUMNS = {"grf_n": "plate1_fz", "cop_x_m": "plate1_cop_x", "cop_y_m": "plate1_cop_y"}
LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
CORNERS_MM = np.array(
    [(250.0, 150.0, 0), (-250.0, 150.0, 0), (-250.0, -150.0, 0), (250.0, -150.0, 0)]
)
UNITS = {
    1: ["N", "N", "N", "mm", "mm", "Nmm"],
    2: ["N"] * 3 + ["Nmm"] * 3,
    3: ["N"] * 8,
    4: ["V"] * 6,
}


def written(path: Path, kind: int = 2, **more: Any) -> Path:
    path.write_bytes(c3d_bytes(with_units(kind, **more), channels(kind)))
    return path


def read(path: Path, stated: ReferenceOptions | None = None) -> ReferenceData:
    return read_reference(path, stated or ReferenceOptions())


PLACED_M = [[np.nan, np.nan], *[[0.01, -0.02]] * 49]
"""The place of the load in the laboratory; the first sample has none."""


def with_units(kind: int, units: list[str] | None = None, **more: Any) -> dict[str, Any]:
    content = force_plate(kind, len(UNITS.get(kind, UNITS[2])), **MORE.get(kind, {}) | more)
    content["ANALOG"]["UNITS"] = units or UNITS.get(kind, UNITS[2])
    return content


def test_a_plate_is_chosen_and_its_axes_turned_by_the_mapping(tmp_path: Path) -> None:
    columns = {"grf_n": "plate1_fz", "cop_x_m": "-plate1_cop_y", "cop_y_m": "plate1_cop_x"}
    found = read(written(tmp_path / "gait.c3d"), ReferenceOptions(columns))
    check(found, atol=1e-6, cop_m=np.array(PLACED_M)[:, ::-1] * [-1.0, 1.0])


def test_a_plate_that_was_not_zeroed_is_noted(tmp_path: Path) -> None:
    analog = channels(2)
    analog[:, 2] += 5.0
    found = read_c3d(tmp_path, force_plate(2, 6, ZERO=[1, 2]), analog)
    check(found, atol=1e-4, grf_n=LOAD_N + 5.0)
    assert "ZERO states frames 1 to 2, in which plates read 24.000" in found.notes[0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("kind", [1, 2, 3])
def test_load_and_reaction_are_read_alike_and_noted(tmp_path: Path, kind: int, sign: float) -> None:
    analog = channels(kind)
    analog[:, [0, 1, 2] if kind == 1 else slice(None)] *= sign
    found = read_c3d(tmp_path, with_units(kind), analog)
    check(found, atol=1e-4, grf_n=LOAD_N)
    check(found, atol=1e-6, cop_m=PLACED_M)
    assert ("the load on the plate" if sign > 0.0 else "the reaction on the foot") in found.notes[0]
    with pytest.raises(FileFormatError, match="negative under load"):
        read(tmp_path / "gait.c3d", ReferenceOptions(sign="-" if sign > 0.0 else "+"))


@pytest.mark.parametrize(
    "force_n",
    [
        np.zeros(5000) + 5.0,  # an offset
        np.random.default_rng(1).normal(size=5000),  # noise
        np.concatenate([np.zeros(1000), np.full(500, 300.0), np.full(500, -120.0)]),
    ],
)
def test_a_sign_that_no_load_tells_has_to_be_stated(tmp_path: Path, force_n: Floats) -> None:
    analog = np.zeros((len(force_n), 6))
    analog[:, 2] = force_n + 0.01 * np.random.default_rng(2).normal(size=len(force_n))
    with pytest.raises(UsageError, match=r"does not tell the sign.*--sign"):
        read_c3d(tmp_path, force_plate(2, 6), analog)
    stated = ReferenceOptions(sign="+")
    check(read(tmp_path / "gait.c3d", stated), atol=1e-4, grf_n=analog[:, 2])


def test_a_spike_of_the_other_sign_is_no_load(tmp_path: Path) -> None:
    analog = np.zeros((5000, 6))
    analog[1000:1600, 2] = -700.0
    analog[3000:3003, 2] = 5000.0
    assert read_c3d(tmp_path, force_plate(2, 6), analog).grf_n[1200] == 700.0


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"USED": 0}, "no force platform"),
        ({"TYPE": [6]}, "of type 6; expected force platforms of types 1 to 4"),
        ({"CHANNEL": np.array([[1, 2, 3, 4, 5, 60]])}, "expected 6 of the 6 channels"),
        ({"CHANNEL": None}, "the channels of nothing"),
        ({"TYPE": [4], "CAL_MATRIX": np.eye(6)[None]}, "no column 'grf_n'"),  # volts no unit
        (
            {"TYPE": [4], "CAL_MATRIX": np.ones((1, 8, 8))},
            "type 4, with a CAL_MATRIX of 8 by",
        ),
        (
            {"TYPE": [4], "CAL_MATRIX": np.ones((1, 1, 6, 6))},
            "type 4, with a CAL_MATRIX of 6 by 6 by 1 by 1;",
        ),
        ({"USED": np.nan}, "no force platform"),
        ({"TYPE": [np.nan]}, "of type nan"),
        ({"CHANNEL": np.full((1, 6), np.nan)}, "the channels 0, 0"),
        ({"CORNERS": np.ones(3), "ORIGIN": np.ones(3), "CHANNEL": np.array(7)}, "the channels 7;"),
    ],
)
def test_what_is_no_plate_is_refused(tmp_path: Path, more: dict[str, Any], said: str) -> None:
    content = with_units(2, UNITS[4] if "CAL_MATRIX" in more else None, **more)
    if more.get("CHANNEL", "") is None:
        del content["FORCE_PLATFORM"]["CHANNEL"]
    with pytest.raises(FileFormatError, match=said):
        read_c3d(tmp_path, content, channels(2))


@pytest.mark.parametrize(
    ("units", "said"),
    [
        (["lbf"] * 3 + ["Nmm"] * 3, "unit of column 'plate1_fz'"),
        ([" "] * 6, "unit of column 'plate1_fz'"),
        (["N"] * 3 + ["lbin"] * 3, "unit of column 'plate1_cop_x'"),
    ],
)
def test_a_missing_unit_has_to_be_stated(tmp_path: Path, units: list[str], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        read_c3d(tmp_path, with_units(2, units), channels(2), ReferenceOptions(COLUMNS))
    factor, unit = (1.0, "N") if units[0] == "N" else (1e3, "kN")
    stated = ReferenceOptions(COLUMNS, {"grf": unit, "cop": "mm"}, "+")
    found = read(tmp_path / "gait.c3d", stated)
    check(found, atol=0.1, grf_n=factor * LOAD_N)
    check(found, atol=1e-6, cop_m=PLACED_M)


@pytest.mark.parametrize("zero", [[np.nan, 10.0], [1.0, np.inf], [3, 1], [1]])
def test_frames_without_load_that_are_no_frames_are_left_out(
    tmp_path: Path, zero: list[float]
) -> None:
    content = with_units(2, ZERO=np.array(zero))
    assert not any("ZERO" in note for note in read_c3d(tmp_path, content, channels(2)).notes)


def test_of_two_plates_none_is_chosen_for_the_user(tmp_path: Path) -> None:
    content = two_plates()
    content["ANALOG"]["UNITS"] = 2 * UNITS[2]
    with pytest.raises(FileFormatError, match="no column 'grf_n'"):
        read_c3d(tmp_path, content, np.hstack([channels(2), 0.5 * channels(2)]))
    found = read(tmp_path / "gait.c3d", ReferenceOptions({"grf_n": "plate2_fz"}))
    check(found, atol=1e-4, grf_n=0.5 * LOAD_N)
    assert "there are 2 plates or soles (plate1, plate2): --map says which one" in found.notes


def test_a_foreign_or_cut_c3d_is_refused_by_name(tmp_path: Path) -> None:
    path = written(tmp_path / "gait.c3d")
    cut = path.read_bytes()[:-600]
    for content in (b"", b"junk", b"\x02\x50" + b"\xff" * 600, cut):
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match=r"gait\.c3d") as caught:
            read(path)
    assert "it ends after 3 frames of 5" in str(caught.value)


@settings(max_examples=300)
@given(at=st.integers(0, 4095), byte=st.integers(0, 255), cut=st.integers(0, 3))
def test_a_damaged_file_is_read_or_refused_by_our_own_errors(
    tmp_path_factory: pytest.TempPathFactory, at: int, byte: int, cut: int
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "gait.c3d"
    written(path)
    content = bytearray(path.read_bytes())
    content[at % len(content)] = byte
    path.write_bytes(content[: len(content) - 700 * cut])
    with suppress(FileFormatError, UsageError):
        read(path)


# --- Independent readings -------------------------------------------------------------------------


def axes_of(rng: np.random.Generator, up: int, facing: float, tilt: float) -> Floats:
    """Return axes of a tilted plate, in rows, with this axis of the laboratory up."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    across = np.roll(np.eye(3), up - 2, axis=1)  # rows: two level axes, then up
    x, z = np.cos(angle) * across[0] + np.sin(angle) * across[1], -facing * across[2]
    y = np.cross(z, x)
    return np.stack([x, np.cos(tilt) * y + np.sin(tilt) * z, np.cos(tilt) * z - np.sin(tilt) * y])


def turn(begin: Floats, end: Floats) -> Floats:
    """Return the rotation by the smallest angle."""
    cross = np.cross(begin, end)
    size = float(np.linalg.norm(cross))
    vector = cross * np.arctan2(size, begin @ end) / size if size > 0.0 else cross
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def in_plane(place: Floats, up: Floats) -> Floats:
    """Return x and y of a place, the laboratory turned until the plate's normal is its z."""
    axis = np.where(np.arange(3) == np.argmax(np.abs(up)), np.sign(up), 0.0)
    return np.asarray(turn(axis, np.array([0.0, 0.0, 1.0])) @ turn(up, axis) @ place)[:2]


@settings(max_examples=100)
@given(
    kind=st.sampled_from([1, 2, 3, 4]),
    signs=st.tuples(st.sampled_from([1.0, -1.0]), st.sampled_from([1.0, -1.0])),
    up=st.sampled_from([(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0)]),
    tilt=st.sampled_from([0.0, 0.1, 0.6]),
    units=st.sampled_from([("mm", "Nmm"), ("m", "Nm"), ("mm", "Nm"), ("cm", "Ncm")]),
    seed=st.integers(0, 1000),
)
def test_any_plate_gives_the_force_and_the_place_that_were_laid_on_it(
    tmp_path_factory: pytest.TempPathFactory,
    kind: int,
    signs: tuple[float, float],
    up: tuple[int, float],
    tilt: float,
    units: tuple[str, str],
    seed: int,
) -> None:
    """Load or reaction, the origin below or above, anywhere, in any units."""
    (sign, raised), (unit, moments), rng = signs, units, np.random.default_rng(seed)
    of_mm = 1e-3 / LENGTHS[unit]
    lever = of_mm if kind == 4 else 1e-3 / LENGTHS[moments.removeprefix("N")]
    axes = axes_of(rng, *up, tilt)
    corners_mm = rng.uniform(-500.0, 500.0, 3) + CORNERS_MM @ axes
    origin = np.array([3.0, -5.0, -40.0]) if kind != 3 else np.array([120.0, 80.0, -40.0])
    force = np.stack([5.0 * rng.normal(size=50), 5.0 * rng.normal(size=50), LOAD_N + 10.0])
    local = np.stack([rng.uniform(-90, 90, 50), rng.uniform(-60, 60, 50), np.zeros(50)])
    # Moments about the origin of the plate, from which the middle of its surface is at `origin`.
    middle = origin if kind in (2, 4) else np.array([0.0, 0.0, origin[2]])
    moment = np.cross(local + middle[:, None], force, axis=0)
    nothing = np.zeros(50)
    matrix = np.eye(6) + 0.05 * rng.normal(size=(6, 6)).round(3)
    if kind == 1:
        rows = [*(sign * force), *(of_mm * local[:2]), nothing]
    elif kind == 3:
        a, b = origin[:2]
        # Vertical forces of the sensors that have this sum and these moments.
        sums = np.array([[1, 1, 1, 1], [b, b, -b, -b], [-a, a, a, -a], [1, -1, 1, -1]])
        z = np.linalg.solve(sums, np.stack([force[2], moment[0], moment[1], nothing]))
        rows = [*(sign * np.stack([0.5 * force[0]] * 2 + [0.5 * force[1]] * 2)), *(sign * z)]
    else:
        rows = [*(sign * force), *(sign * lever * moment)]
    if kind == 4:
        rows = list(np.linalg.solve(matrix, np.stack(rows)))
    above = np.array([1.0, 1.0, raised]) if kind == 3 else np.full(3, raised * (kind != 1))
    more = {"CORNERS": of_mm * corners_mm[None], "ORIGIN": (of_mm * above * origin)[None]}
    if kind == 4:
        more["CAL_MATRIX"] = matrix.T.reshape(1, 6, 6)
    content = force_plate(kind, len(rows), **more)
    content["POINT"]["UNITS"] = [unit]
    of = {"mm": unit, "Nmm": moments}
    content["ANALOG"]["UNITS"] = [of.get(each, each) for each in UNITS[kind]]
    stated = ReferenceOptions(COLUMNS, {"grf": "N", "cop": unit} if kind == 4 else {})
    folder = tmp_path_factory.mktemp("plates")
    found = read_c3d(folder, content, np.stack(rows, axis=1), stated)
    placed_mm = corners_mm.mean(axis=0)[:, None] + axes[:2].T @ local[:2]
    np.testing.assert_allclose(found.grf_n, force[2], rtol=1e-5)
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m.T, 1e-3 * in_plane(placed_mm, -axes[2]), atol=2e-5)


@pytest.mark.parametrize("kind", [1, 2, 4])
def test_another_program_reads_the_same(tmp_path: Path, kind: int) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    path = written(tmp_path / "gait.c3d", kind)
    found = read(path, ReferenceOptions(COLUMNS, {"grf": "N", "cop": "mm"} if kind == 4 else {}))
    plate = ezc3d.c3d(str(path), extract_forceplat_data=True)["data"]["platform"][0]
    check(found, rtol=1e-12, grf_n=-plate["force"][2])
    cop_m = 1e-3 * plate["center_of_pressure"][:2].T
    cop_m[0] = np.nan
    check(found, rtol=1e-9, cop_m=cop_m)


# --- Forms of the file ----------------------------------------------------------------------------


def test_over_32767_frames_of_unsigned_integers_are_read(tmp_path: Path) -> None:
    frames = 40_000
    counts = np.zeros((frames, 6))
    counts[:, 2] = 32_768 + np.where(np.arange(frames) % 1000 < 300, 20_000, 0)
    content = force_plate(2, 6)
    content["ANALOG"] |= {
        "FORMAT": ["UNSIGNED"],
        "OFFSET": np.array([0, 0, 32_768, 0, 0, 0]),
        "SCALE": np.full(6, 0.05),
        "RATE": 100.0,
    }
    content["POINT"] |= {"FRAMES": frames, "SCALE": 1.0}
    found = read_c3d(tmp_path, content, counts, samples_a_frame=1, is_integer=True)
    assert len(found.grf_n) == frames
    assert (found.grf_n[0], found.grf_n[500]) == (pytest.approx(1000.0), 0.0)


@pytest.mark.parametrize(
    "more",
    [
        {"POINT": {"FRAMES": np.array([70_000.0])}},
        {"POINT": {"LONG_FRAMES": np.array([70_000.0])}},
        {"TRIAL": {"ACTUAL_START_FIELD": [1, 0], "ACTUAL_END_FIELD": [70_000 - 65_536, 1]}},
    ],
)
def test_frames_beyond_65535_are_counted_as_the_file_states_them(
    tmp_path: Path, more: dict[str, dict[str, Any]]
) -> None:
    frames = 70_000
    analog = np.zeros((frames, 6))
    analog[::1000, 2] = 100.0
    analog[1::1000, 2] = 100.0
    content = force_plate(2, 6)
    content["ANALOG"]["RATE"] = 100.0
    for group, values in more.items():
        content[group] = {**content.get(group, {}), **values}
    more_frames: dict[str, Any] = {"samples_a_frame": 1, "frames_in_header": 65_535}
    assert len(read_c3d(tmp_path, content, analog, **more_frames).grf_n) == frames


def test_a_file_without_a_rate_of_points_is_read_by_its_analog_rate(tmp_path: Path) -> None:
    content = force_plate(2, 6)
    content["POINT"]["RATE"] = 0.0
    found = read_c3d(tmp_path, content, channels(2), point_hz=0.0)
    check(found, rtol=1e-7, time_s=np.arange(50) / 1000.0)


def test_a_plate_without_channels_leaves_the_others_alone(tmp_path: Path) -> None:
    content = two_plates(CHANNEL=np.array([[1, 2, 3, 4, 5, 6], [0] * 6]))
    content["ANALOG"] = force_plate(2, 6)["ANALOG"]
    found = read_c3d(tmp_path, content, channels(2))
    check(found, atol=1e-4, grf_n=LOAD_N)
    assert "plate 2 is not read" in found.notes[0]


def test_a_plate_without_places_of_sensors_has_no_cop(tmp_path: Path) -> None:
    found = read(written(tmp_path / "gait.c3d", 3, ORIGIN=np.zeros((1, 3))))
    check(found, atol=1e-4, grf_n=LOAD_N)
    assert found.cop_m is None
    assert "no centre of pressure" in found.notes[0]


def test_a_cop_off_the_plate_without_load_is_nan(tmp_path: Path) -> None:
    analog = channels(2)
    analog[0, 2:5] = (1e-13, 1.0, 1.0)
    check(read_c3d(tmp_path, force_plate(2, 6), analog), atol=1e-6, cop_m=PLACED_M)


def test_a_file_is_read_where_memory_is_limited(tmp_path: Path) -> None:
    path = written(tmp_path / "gait.c3d")
    code = (
        "import resource, pathlib\n"
        "from storage.formats.reference import ReferenceOptions, read_reference\n"
        "resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))\n"
        f"print(len(read_reference(pathlib.Path({str(path)!r}), ReferenceOptions()).grf_n))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "50"


def test_too_little_memory_is_the_cause(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "gait.c3d")

    def refuse(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(C3dFile, "get_scaled_samples_by_channel", refuse)
    with pytest.raises(
        FileFormatError, match=r"not enough memory to read it; .*fits in memory.*ulimit -v"
    ):
        read(path)


SAMPLES = 200
ODD_N = 100.0 + 400.0 * np.sin(np.linspace(0.0, np.pi, SAMPLES))
ODD_X_MM, ODD_Y_MM = np.linspace(-80.0, 120.0, SAMPLES), np.linspace(40.0, -30.0, SAMPLES)
"""Of the load in the plate's own axes, of which y and z are turned in the laboratory's."""


def wrench() -> Floats:
    nothing = np.zeros(SAMPLES)
    return np.stack([nothing, nothing, ODD_N, ODD_Y_MM * ODD_N, -ODD_X_MM * ODD_N, nothing], axis=1)


def is_right(found: ReferenceData, *, y: float = -1.0) -> None:
    check(found, rtol=1e-5, grf_n=ODD_N)
    check(found, atol=2e-6, cop_m=1e-3 * np.stack([ODD_X_MM, y * ODD_Y_MM], axis=1))


def test_channels_in_place_of_samples_are_told_by_the_rates(tmp_path: Path) -> None:
    found = read_c3d(tmp_path, force_plate(2, 6), wrench(), measures_in_header=6)
    is_right(found)
    assert found.time_s[1] == pytest.approx(0.001)


def test_of_two_analog_rates_that_of_the_frames_is_used(tmp_path: Path) -> None:
    content = force_plate(2, 6)
    content["ANALOG"]["RATE"] = 980.0
    found = read_c3d(tmp_path, content, wrench())
    assert found.time_s[1] == pytest.approx(0.001)
    assert "ANALOG:RATE states 980 Hz, and 10 samples in each frame at 100 Hz are" in found.notes[0]


def test_zeros_behind_the_last_sample_of_unsigned_channels_are_no_load(tmp_path: Path) -> None:
    counts = np.zeros((5000, 6))
    counts[:2000] = 2048.0
    counts[500:1000, 2] += 800.0
    content = force_plate(2, 6)
    content["ANALOG"] |= {"OFFSET": np.full(6, 2048), "SCALE": np.full(6, -1.0)}
    content["POINT"]["SCALE"] = 1.0
    found = read_c3d(tmp_path, content, counts, is_integer=True)
    assert len(found.grf_n) == 2000
    assert (found.grf_n.max(), found.grf_n.min()) == (800.0, 0.0)
    assert "plate1: 3000 of its samples are stored as zeros and were not recorded" in found.notes


@pytest.mark.parametrize(
    ("position", "stated", "held"), [("mm", "Nm", "Nmm"), ("m", "Nmm", "Nm"), ("mm", "Nm", "Nm")]
)
def test_moments_in_another_unit_are_told_by_the_size_of_the_plate(
    tmp_path: Path, position: str, stated: str, held: str
) -> None:
    analog, content = wrench(), force_plate(2, 6)
    if held == "Nm":
        analog[:, 3:5] *= 1e-3
    if position == "m":
        for name in ("CORNERS", "ORIGIN"):
            content["FORCE_PLATFORM"][name] = 1e-3 * content["FORCE_PLATFORM"][name]
    content["POINT"]["UNITS"] = [position]
    content["ANALOG"]["UNITS"] = ["N"] * 3 + [stated] * 3
    found = read_c3d(tmp_path, content, analog)
    is_right(found)
    is_said = any("are not in" in note for note in found.notes)
    assert is_said == (stated != held)


def test_a_plate_whose_corners_run_the_other_way_round_faces_up(tmp_path: Path) -> None:
    content = force_plate(2, 6)
    content["FORCE_PLATFORM"]["CORNERS"] = content["FORCE_PLATFORM"]["CORNERS"][:, [3, 2, 1, 0]]
    found = read_c3d(tmp_path, content, wrench())
    is_right(found, y=1.0)  # each corner is in the quadrant that its number says
    assert any("CORNERS run counterclockwise" in note for note in found.notes)


@pytest.mark.parametrize(("factor", "said"), [(3.0, "off the plate in"), (1e-3, "the middle")])
def test_a_cop_that_no_foot_has_is_noted(tmp_path: Path, factor: float, said: str) -> None:
    analog = wrench()
    analog[:, 3:5] *= factor
    notes = read_c3d(tmp_path, force_plate(2, 6), analog).notes
    assert any(said in note for note in notes)
    assert not any(said in note for note in read_c3d(tmp_path, force_plate(2, 6), wrench()).notes)


# --- Matrices -------------------------------------------------------------------------------------


MIXED = np.eye(6) + 0.1 * np.random.default_rng(3).normal(size=(6, 6))


@pytest.mark.parametrize("is_by_row", [False, True])
def test_a_matrix_is_read_by_row_where_the_file_says_so(tmp_path: Path, is_by_row: bool) -> None:
    """A matrix is stored by columns otherwise."""
    volts = np.asarray(np.linalg.solve(MIXED, wrench().T).T, dtype=np.float64)
    content = with_units(4, CAL_MATRIX=(MIXED if is_by_row else MIXED.T)[None])
    content["FORCE_PLATFORM"]["MATRIX_STORE"] = ["BYROW" if is_by_row else "BYCOLUMN"]
    stated = ReferenceOptions(COLUMNS, {"grf": "N", "cop": "mm"})
    is_right(read_c3d(tmp_path, content, volts, stated))


def test_bending_of_a_plate_is_corrected_as_ezc3d_does(tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    polynomial = np.array(
        [1e-15, -5e-11, 3e-07, 2e-15, -1e-9, 1e-2, -2e-15, 2e-11, -7e-07, 1e-15, 3e-9, 2e-2]
    )
    more: dict[str, Any] = {"CAL_MATRIX": np.zeros((1, 6, 6))}
    more |= {"FPCOPPOLY": polynomial.reshape(1, 2, 6), "ORIGIN": np.array([[150.0, 80.0, -40.0]])}
    content = with_units(3, **more)
    shear = 0.05 * ODD_N
    vertical = on_sensors(ODD_N, ODD_X_MM / 300.0, ODD_Y_MM / 160.0)
    analog = np.stack([shear, shear, -shear, -shear, *vertical], axis=1)
    found = read_c3d(tmp_path, content, analog)
    path = str(tmp_path / "gait.c3d")
    plate = ezc3d.c3d(path, extract_forceplat_data=True)["data"]["platform"][0]
    check(found, atol=1e-9, cop_m=1e-3 * plate["center_of_pressure"][:2].T)
    assert found.cop_m is not None
    assert float(np.ptp(1e3 * found.cop_m[:, 0] - ODD_X_MM)) > 1.0
    assert any("FPCOPPOLY" in note for note in found.notes)

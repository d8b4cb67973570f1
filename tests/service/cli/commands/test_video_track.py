"""`foottile video track`, and `foottile estimate --angle` with its table."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from service.video.alignment import fit_alignment
from storage.formats.angle_table import ANGLE_NAME, read_angle_table
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.videos import find_video_folder, read_video, write_video
from storage.sessions.writer import SealedFileWriter
from studies.reproduce.leg_film import LOWER_TAG, UPPER_TAG, Camera, film_leg, write_film
from tests.builders.arrays import UTC_NS, make_array, make_servo
from tests.service.cli.commands.test_any_value import PLACES
from tests.service.cli.outcome import Run
from tests.service.sessions.pieces import calibration, frames, hopping

PICTURES = 16
TAGS = "--tags", f"{LOWER_TAG},{UPPER_TAG}"


def swing(t_s: float) -> float:
    return 0.1 * math.sin(2.0 * math.pi * t_s)


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    camera, begin_s = Camera(), [i / 50.0 for i in range(PICTURES)]
    pictures = film_leg(camera, begin_s, swing, np.random.default_rng(1))
    return write_film(tmp_path_factory.mktemp("film") / "leg.mp4", camera, pictures, begin_s)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder of a session of a second and a half."""
    folder = tmp_path / "session"
    folder.mkdir()
    notes = {"calibration": calibration().model_dump(mode="json")}
    with SealedFileWriter(folder / FRAMES_NAME, make_array(servo=make_servo()), notes) as writer:
        part = np.zeros(750, dtype=np.uint16)
        writer.append_frames(frames(hopping(750, loaded_from=300), lead=200), {"part": part})
    return folder


def test_the_angle_of_a_film_is_tracked_and_estimated(run: Run, folder: Path, film: Path) -> None:
    video_id = run("video", "add", folder, film, "--json").printed()["id"]
    place = find_video_folder(folder, video_id)
    tracked = run("video", "track", folder, video_id, *TAGS, "--scale", 180).succeeds()
    assert f"{PICTURES} of {PICTURES} pictures have an angle" in tracked.out
    assert "`foottile video align` comes before" in tracked.err
    run("estimate", folder, "--angle", place / ANGLE_NAME, "--out", "out.parquet").fails(
        2, "not aligned"
    )
    table = pq.read_table(place / ANGLE_NAME)
    apart_m = np.hypot(
        *(
            table[f"upper_{k}_m"].to_numpy() - table[f"lower_{k}_m"].to_numpy()
            for k in ("up", "forward")
        )
    )
    assert np.median(apart_m) == pytest.approx(0.18)
    # Aligned afterwards: the table beside the film follows.
    alignment = fit_alignment(
        "hand", np.array([0.0]), np.array([1e9]), np.array([1e5]), begin_t_ns=UTC_NS
    )
    write_video(place, read_video(place).model_copy(update={"alignment": alignment}))
    run("estimate", folder, "--angle", place / ANGLE_NAME, "--out", "out.parquet").succeeds()
    found = pq.read_table("out.parquet")
    is_known = np.array(found["angle_source"].to_pylist()) == "video"
    t_s = (found["t_ns"].to_numpy() - UTC_NS) * 1e-9 - 1.0
    assert is_known.tolist() == ((t_s > -1e-4) & (t_s < (PICTURES - 1) / 50.0 + 1e-4)).tolist()
    true_rad = [swing(t + 0.003) for t in t_s[is_known]]
    off_deg = np.degrees(found["angle_rad"].to_numpy()[is_known] - true_rad)
    assert np.abs(off_deg).max() < 0.2
    report = run(
        "video", "track", folder, video_id, *TAGS, "-o", "t.csv", "--zero", 2, "--forward", "left",
        "--json",
    ).printed()  # fmt: skip
    assert report["aligned"]
    other = read_angle_table(Path("t.csv"))
    assert other.t_ns is not None
    np.testing.assert_allclose(other.t_ns[:2] - UTC_NS, [1e9, 1.02e9], atol=1000)
    np.testing.assert_allclose(
        other.angle_rad, -table["angle_rad"].to_numpy() - math.radians(2.0), atol=1e-9
    )
    run("video", "remove", folder, video_id).succeeds()
    assert [path.name for path in folder.iterdir()] == [FRAMES_NAME]


def test_points_of_another_program_take_the_times_of_the_film(
    run: Run, folder: Path, film: Path
) -> None:
    video_id = run("video", "add", folder, film, "--json").printed()["id"]
    Path("dlc.csv").write_text(
        "scorer,n,n,n,n,n,n\nbodyparts,a,a,a,b,b,b\ncoords,x,y,likelihood,x,y,likelihood\n"
        + "".join(f"{picture},10,300,1,20,100,1\n" for picture in range(1, 15, 2))
    )
    track = "video", "track", folder, video_id, "--points-file"
    run(*track, "dlc.csv", "--points", "a,b", "-o", "t.csv").succeeds()
    found = read_angle_table(Path("t.csv"))
    assert found.film_s is not None
    np.testing.assert_allclose(found.film_s, np.arange(1, 15, 2) * 0.02, atol=1e-6)
    np.testing.assert_allclose(found.angle_rad, math.atan2(10.0, 200.0))
    Path("dlc.csv").write_text(Path("dlc.csv").read_text() + "16,10,300,1,20,100,1\n")
    run(*track, "dlc.csv", "--points", "a,b").fails(1, "dlc.csv", "last picture is 16", "0 to 15")
    rows = "".join(f"{20 * i},0,0,0,9\n" for i in range(PICTURES))
    Path("k.csv").write_text(f"Time,a/0/X,a/0/Y,b/0/X,b/0/Y\n{rows}")
    run(*track, "k.csv", "--points", "a,b").fails(1, "k.csv", "20 s apart", "seconds of the film")
    Path("k.csv").write_text(f"Time,a/0/X,a/0/Y,b/0/X,b/0/Y\n{rows.replace('0,0,', '0e-3,0,')}")
    # In space, without a film.
    command = "video", "track", folder, "--points-file", "k.csv", "--points", "a,b"
    run(*command, "--begin-s", 0.5, "-o", "s.parquet").succeeds()
    in_space = read_angle_table(Path("s.parquet"))
    assert in_space.film_s is None
    assert in_space.t_ns is not None
    assert in_space.t_ns[0] == UTC_NS + 500_000_000
    run(*command, "--begin-s", 0.5).fails(2, "no video is named")
    run(*command[:3], video_id, *command[3:], "--begin-s", 1).fails(2, "points in space")


REFUSED: tuple[tuple[tuple[str, ...], str], ...] = (
    ((), "one of --tags, --dots and --points-file"),
    (("--tags", "3,7", "--dots", "red"), "one of --tags"),
    (("--tags", "3"), "--tags '3'"),
    (("--tags", "3,3"), "0 to 49"),
    (("--tags", "3,50"), "0 to 49"),
    (("--tags", "3,-4"), "numbers, such as 3,7"),
    (("--dots", "beige"), "no dots of the colour 'beige'"),
    (("--dots", "red", "--board", "9"), "9x6"),
    (("--dots", "red", "--scale", "0"), "millimetres"),
    (("--dots", "red", "--zero", "400"), "degrees"),
    (("--dots", "red", "--forward", "x"), "right or left"),
    (("--dots", "red", "--area", "1,2,3"), "400,0,600,1080"),
    (("--dots", "red", "--area", "1,2,0,3"), "above 0"),
    (("--dots", "red", "--area", "1,2,9999,3"), "the area reaches to 10000, 5"),
    (("--dots", "red", "-o", "t.xlsx"), ".parquet or .csv"),
    (("--dots", "red", "-o", f"session/{FRAMES_NAME}"), "is an input and would be lost"),
    (("--dots", "red", "-o", "nowhere/t.csv"), "no folder"),
    (("--points", "a,b"), "--tags"),
    (("--points-file", "x.csv"), "both or none"),
    (("--points-file", "x.csv", "--points", "a,b", "--area", "1,2,3,4"), "are for --tags and"),
    (("--points-file", "x.csv", "--points", "a,b", "--lens", "b.mp4"), "are for --tags and"),
    (("--dots", "red", "-o", "session/notes/t.csv"), "is an input and would be lost"),
    (("--points-file", "x.csv", "--points", "a"), "LOWER,UPPER"),
)


def test_options_that_do_not_fit_are_refused(run: Run, folder: Path, film: Path) -> None:
    video_id = run("video", "add", folder, film, "--json").printed()["id"]
    (folder / "notes").mkdir()
    (folder / "notes" / "t.csv").write_text("mine")
    for options, problem in REFUSED:
        run("video", "track", folder, video_id, *options).fails(2, problem)
    swapped = "--tags", f"{UPPER_TAG},{LOWER_TAG}"
    track = "video", "track", folder, video_id, *swapped, "-o", "t.csv"
    run(*track).fails(1, "leg.mp4", "first marker named is above", "lower marker first")
    assert not Path("t.csv").exists()
    run(*track, "--zero", 180).succeeds()
    run("video", "track", folder, "0" * 12, "--dots", "red").fails(1, "no video", video_id)
    by_contact = "video", "align", folder, video_id, "--by", "contact"
    run(*by_contact, *TAGS).fails(1, "no estimates")


def test_a_special_file_is_refused_as_points(run: Run, folder: Path, tmp_path: Path) -> None:
    for name, make in PLACES.items():
        for suffix in (".csv", ".c3d"):
            make(tmp_path / f"{name}{suffix}")
            points = "--points-file", f"{name}{suffix}", "--points", "a,b", "--begin-s", 0
            assert run("video", "track", folder, *points, "-o", "t.csv").code in (1, 2)
    assert not Path("t.csv").exists()


def test_the_table_of_another_session_and_of_many_are_refused(run: Run, folder: Path) -> None:
    Path("a.csv").write_text("t_ns,angle_rad,sigma_rad\n5,0,0.1\n6,0,0.1\n")
    estimate = "estimate", "--angle", "a.csv", "--out", "out.parquet"
    run(*estimate, folder).fails(1, "a table of this session")
    run(*estimate, folder, folder).fails(2, "one session")
    run("estimate", folder, "--angle", folder / FRAMES_NAME, "--out", "out.parquet").fails(
        1, "angle_rad, sigma_rad is missing"
    )

"""A session estimated with the angle of a table in place of the servo's."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, UsageError
from devices.flags import FrameFlag
from devices.frames import NO_SERVO_COUNTS, ServoInfo
from service.offline.estimate.preparation import EstimateRequest
from service.offline.estimate.session import estimate_session
from service.offline.estimate.table_angle import (
    AngleTrack,
    check_film_of_session,
    read_angle_track,
)
from storage.formats.angle_table import ANGLE_NAME, AngleTable
from storage.formats.slice import Slice
from storage.schema import ANGLE_COLUMNS, ESTIMATE_COLUMNS, MEASURED_COLUMNS
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.reader import SealedFileReader
from storage.sessions.videos import VIDEO_NAME, Alignment, Video, write_video
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array, make_servo
from tests.builders.frames import make_frames
from tests.service.sessions.pieces import calibration, frames, hopping
from tests.storage.sessions.test_videos import INFO

N = 3000
INTERVAL_NS = 20_000_000
_NAMES = [column.name for column in (*MEASURED_COLUMNS, *ESTIMATE_COLUMNS)]
_ANGLE_NAMES = [column.name for column in ANGLE_COLUMNS]


def swing(t_ns: np.ndarray) -> np.ndarray:
    return 0.3 * np.sin(2.0 * math.pi * 0.7e-9 * (t_ns - UTC_NS))


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose servo stands still and is stale half of the time."""
    return write_session(tmp_path_factory.mktemp("raw") / "raw.parquet", make_servo())


def write_session(path: Path, servo: ServoInfo | None) -> Path:
    notes = {"calibration": calibration().model_dump(mode="json")}
    batch = frames(hopping(N, loaded_from=300), lead=200, servo_counts=2048, servo_age_us=500)
    batch.frame_flags[N // 2 :] |= np.uint8(FrameFlag.SERVO_STALE)
    with SealedFileWriter(path, make_array(servo=servo), notes) as writer:
        writer.append_frames(batch, {})
    return path


def make_track(sigma_rad: float = 1e-3, sigma_ns: float = 0.0) -> AngleTrack:
    t_ns = np.arange(UTC_NS, UTC_NS + N * PERIOD_NS, INTERVAL_NS)
    count = len(t_ns)
    noise_rad = np.random.default_rng(3).normal(0.0, sigma_rad, count)
    return AngleTrack(
        t_ns,
        swing(t_ns) + noise_rad,
        np.full(count, sigma_rad),
        np.full(count, sigma_ns),
        np.full(count, "video"),
        {"table": "angle.csv"},
    )


def estimate(
    source: Path, out: Path, angle: AngleTrack | None, part: Slice | None = None
) -> dict[str, np.ndarray]:
    request = EstimateRequest(
        calibration=None,
        models=("static", "denoise"),
        lag_ms=100.0,
        scene=None,
        tare_s=None,
        part=part or Slice(),
        unquantized=True,
    )
    estimate_session(source, out, request, on_remark=lambda _: None, angle=angle)
    with SealedFileReader(out) as session:
        names = [*_NAMES, *(_ANGLE_NAMES if angle is not None else ())]
        assert session.has_columns(*_ANGLE_NAMES) == (angle is not None)
        assert ("angle" in session.notes) == (angle is not None)
        pieces = list(session.read_quantities(*names))
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


def test_the_tables_angle_moves_the_ground_and_nothing_else(raw: Path, tmp_path: Path) -> None:
    by_servo = estimate(raw, tmp_path / "servo.parquet", None)
    by_table = estimate(raw, tmp_path / "table.parquet", make_track())
    for name in set(_NAMES) - {"angle_rad", "cop_ground_x_m", "cop_ground_y_m"}:
        np.testing.assert_array_equal(by_table[name], by_servo[name], err_msg=name)
    known = by_table["angle_source"] == "video"
    assert known.sum() > 0.99 * N
    off_rad = by_table["angle_rad"] - swing(by_table["t_ns"])
    ratio = off_rad[known] / by_table["angle_sigma_rad"][known]
    assert 0.7 < np.sqrt(np.mean(ratio**2)) < 1.2
    # In the COP on the ground, too, also where the servo was stale.
    on_ground = ~np.isnan(by_table["cop_ground_x_m"])
    assert on_ground[N // 2 :].any()
    assert np.all(
        by_table["cop_ground_sigma_x_m"][on_ground] >= by_table["cop_sigma_x_m"][on_ground]
    )
    x_m, angle_rad = by_table["cop_x_m"], by_table["angle_rad"]
    expected_m = 0.15 * angle_rad + x_m * np.cos(angle_rad) - 0.15 * np.sin(angle_rad)
    np.testing.assert_allclose(
        by_table["cop_ground_x_m"][on_ground], expected_m[on_ground], atol=1e-6
    )


def test_how_far_the_table_reaches_and_agrees_with_the_servo_is_said(tmp_path: Path) -> None:
    source = write_session(tmp_path / "raw.parquet", make_servo())
    t_ns = np.arange(UTC_NS, UTC_NS + N // 4 * PERIOD_NS, INTERVAL_NS)
    constant = np.full(len(t_ns), 0.1)
    track = replace(
        make_track(), t_ns=t_ns, angle_rad=constant, sigma_rad=constant, sigma_ns=constant
    )
    said: list[str] = []
    request = EstimateRequest(None, ("static",), 100.0, None, None, Slice(), unquantized=True)
    estimate_session(source, tmp_path / "out", request, on_remark=said.append, angle=track)
    assert said[-1] == (
        "the table has an angle in 25 % of the frames; it differs from the servo's by 5.7 degrees "
        "(RMS)"
    )
    # Of a part its own frames count, not those that the estimator needs before it and after it.
    for part, share in ((Slice(1.6, 3.0), 0), (Slice(0.5, 1.0), 100)):
        in_part = replace(request, part=part)
        estimate_session(source, tmp_path / "out", in_part, on_remark=said.append, angle=track)
        assert said[-1].startswith(f"the table has an angle in {share} % of the frames"), part


def test_a_film_of_another_session_is_refused(raw: Path, tmp_path: Path) -> None:
    for name in ("own", "other"):
        folder = tmp_path / name / f"video-{'0' * 12}"
        folder.mkdir(parents=True)
        (folder / VIDEO_NAME).write_text("")
    shutil.copy(raw, tmp_path / "own" / FRAMES_NAME)
    with SealedFileWriter(
        tmp_path / "other" / FRAMES_NAME, make_array(stream_id="f" * 32), {}
    ) as writer:
        writer.append_frames(make_frames(10), {})
    check_film_of_session(folder.parent.parent / "own" / folder.name / ANGLE_NAME, raw)
    check_film_of_session(tmp_path / ANGLE_NAME, raw)
    with pytest.raises(UsageError, match="of a film of another session, other"):
        check_film_of_session(folder / ANGLE_NAME, raw)


def test_where_the_table_has_a_gap_the_angle_is_unknown_and_never_the_servos(
    raw: Path, tmp_path: Path
) -> None:
    whole = make_track()
    seen = np.ones(len(whole.t_ns), dtype=np.bool_)
    seen[[50, *range(100, 110)]] = False  # one picture is no gap
    track = AngleTrack(
        whole.t_ns[seen],
        whole.angle_rad[seen],
        whole.sigma_rad[seen],
        whole.sigma_ns[seen],
        whole.source[seen],
        whole.origin,
    )
    found = estimate(raw, tmp_path / "out.parquet", track)
    t_ns = found["t_ns"]
    unknown = (t_ns > whole.t_ns[99]) & (t_ns < whole.t_ns[110])
    unknown |= t_ns > whole.t_ns[-1]
    np.testing.assert_array_equal(found["angle_source"] == "none", unknown)
    for name in ("angle_rad", "angle_sigma_rad", "cop_ground_x_m", "cop_ground_sigma_x_m"):
        assert np.isnan(found[name][unknown]).all(), name
    assert not np.isnan(found["angle_rad"][~unknown]).any()


def test_a_part_has_the_values_of_the_whole(raw: Path, tmp_path: Path) -> None:
    whole = estimate(raw, tmp_path / "whole.parquet", make_track())
    part = estimate(raw, tmp_path / "part.parquet", make_track(), Slice(2.0, 3.0))
    inside = np.isin(whole["seq"], part["seq"])
    assert inside.sum() == 500
    for name in ("angle_rad", "angle_sigma_rad", "angle_source"):
        np.testing.assert_array_equal(part[name], whole[name][inside])


def test_a_session_without_a_servo_gets_the_angle_alone(tmp_path: Path) -> None:
    raw = write_session(tmp_path / "raw.parquet", None)
    found = estimate(raw, tmp_path / "out.parquet", make_track())
    assert np.isfinite(found["angle_rad"]).sum() > 0.99 * N
    assert np.isnan(found["cop_ground_x_m"]).all()
    assert (found["servo_counts"] == 2048).all()
    assert NO_SERVO_COUNTS not in found["servo_counts"]


def test_an_uncertain_instant_makes_a_fast_angle_uncertain() -> None:
    track = make_track(sigma_rad=1e-6, sigma_ns=10e6)
    t_ns = track.t_ns[:200] + INTERVAL_NS // 2
    _, sigma_rad, _ = track.interpolate(t_ns)
    rate_rad_s = np.abs(np.gradient(swing(t_ns), INTERVAL_NS * 1e-9))
    np.testing.assert_allclose(sigma_rad, 0.010 * rate_rad_s, atol=6e-4)


def test_a_turn_within_a_gap_is_in_the_uncertainty() -> None:
    """Half a swing of 0.1 rad in 0.1 s is hidden: the line between its ends says nothing of it."""
    seen = np.concatenate([np.arange(0, 11), np.arange(15, 26)])
    t_ns, zero = UTC_NS + seen * INTERVAL_NS, np.zeros(22)
    angle_rad = 0.1 * np.sin((seen - 10) * INTERVAL_NS * 1e-9 * math.pi / 0.1)
    track = AngleTrack(t_ns, angle_rad, zero + 1e-4, zero, np.full(22, "video"), {})
    found_rad, sigma_rad, _ = track.interpolate(np.array([UTC_NS + 25 * INTERVAL_NS // 2]))
    assert abs(found_rad[0] - 0.1) < 2.0 * sigma_rad[0]


def test_a_table_of_another_time_is_refused(raw: Path, tmp_path: Path) -> None:
    track = make_track()
    other = replace(track, t_ns=track.t_ns + 3_600_000_000_000)
    with pytest.raises(
        FileFormatError, match=r"from 3600.0 to 3606.0 s of the session.*6.0 s long"
    ):
        estimate(raw, tmp_path / "out.parquet", other)
    assert not (tmp_path / "out.parquet").exists()


def test_a_films_table_takes_the_alignment_beside_it(tmp_path: Path) -> None:
    film_s = np.array([0.0, 0.02, 0.04, 0.06])
    table = AngleTable(np.zeros(4), np.full(4, 1e-3), film_s=film_s)
    table.write(tmp_path / ANGLE_NAME)
    with pytest.raises(UsageError, match="not aligned"):
        read_angle_track(tmp_path / ANGLE_NAME)
    alignment = Alignment(
        method="hand",
        film_s=0.0,
        t_ns=UTC_NS,
        drift=1e-3,
        sigma_ns=2e6,
        sigma_drift=0.0,
        pair_count=1,
        rejected_count=0,
    )
    film = INFO.model_copy(update={"picture_count": 4, "duration_s": 0.06})
    video = Video(
        id="0" * 12, name="a.mp4", suffix=".mp4", size_bytes=1, sha256="0" * 64,
        times_sha256="0" * 64, added_t_ns=1,
        film=film, alignment=alignment,
    )  # fmt: skip
    write_video(tmp_path, video)
    found = read_angle_track(tmp_path / ANGLE_NAME)
    np.testing.assert_array_equal(found.t_ns, UTC_NS + np.arange(4) * 20_020_000)
    replace(table, t_ns=found.t_ns, sigma_ns=found.sigma_ns).write(tmp_path / ANGLE_NAME)
    write_video(tmp_path, video.model_copy(update={"alignment": None}))
    with pytest.raises(UsageError, match="not aligned"):  # what was wrong does not come back
        read_angle_track(tmp_path / ANGLE_NAME)
    # With the rolling shutter of a film of 50 pictures a second.
    np.testing.assert_allclose(found.sigma_ns, math.hypot(2e6, 20e6 / math.sqrt(12.0)))

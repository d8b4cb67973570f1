"""Angle of a leg in rendered films: tags and dots, codecs, rates, blur, gaps."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, UsageError
from service.video.container import iterate_pictures, read_film
from service.video.tracking import compute_angle, make_dot_finder, make_tag_finder, track_markers
from studies.reproduce.leg_film import LOWER_TAG, UPPER_TAG, Camera, film_leg, write_film


def swing(t_s: float) -> float:
    return 0.35 * math.sin(2.0 * math.pi * 0.8 * t_s)


@pytest.mark.slow(parts=4)
@pytest.mark.parametrize(
    ("camera", "suffix", "marks"),
    [
        (Camera(), "mp4", "tags"),
        (Camera(codec="libvpx-vp9"), "webm", "dots"),
        (Camera(rate_hz=240.0, exposure=0.8), "mkv", "tags"),
        (Camera(rate_hz=1000.0), "mov", "dots"),
    ],
    ids=["h264-tags", "vp9-dots", "240-blurred", "1000-dots"],
)
def test_the_angle_of_each_picture_is_right_within_what_it_says(
    tmp_path: Path, camera: Camera, suffix: str, marks: str
) -> None:
    generator = np.random.default_rng(7)
    begin_s = np.arange(40) / camera.rate_hz
    pictures = film_leg(camera, begin_s.tolist(), swing, generator, marks=marks)
    hidden = 12  # a hand before the lens
    pictures[hidden][:] = 90
    path = write_film(tmp_path / f"film.{suffix}", camera, pictures, begin_s.tolist())
    film, times_s = read_film(path)
    assert film.picture_count == 40
    np.testing.assert_allclose(times_s, begin_s, atol=1e-3)
    find = make_tag_finder(LOWER_TAG, UPPER_TAG) if marks == "tags" else make_dot_finder("bright")
    places_px = track_markers(path, film.picture_count, find, is_grey=True)
    angle_rad, sigma_rad = compute_angle(places_px * (1.0, -1.0), zero_rad=0.0)
    exposure_s = camera.exposure / camera.rate_hz
    true_rad = np.array([swing(t_s + exposure_s / 2) for t_s in begin_s])
    off_deg = np.degrees(angle_rad - true_rad)
    assert np.flatnonzero(np.isnan(off_deg)).tolist() == [hidden]
    assert np.nanmax(np.abs(off_deg)) < 0.2
    sigma_deg = np.degrees(sigma_rad)
    assert np.sqrt(np.nanmean((off_deg / sigma_deg) ** 2)) < 2.5


def test_a_zero_turns_the_angle_and_no_angle_is_beyond_half_a_turn() -> None:
    ahead, up = 200.0 * math.sin(3.0), 200.0 * math.cos(3.0)
    places = np.array([[[100.0, -300.0], [100.0 + ahead, -300.0 + up]]] * 9)
    assert compute_angle(places, zero_rad=0.1)[0] == pytest.approx(2.9)
    angle_rad, sigma_rad = compute_angle(places, zero_rad=-1.0)
    assert angle_rad == pytest.approx(4.0 - 2.0 * math.pi)
    assert sigma_rad == pytest.approx(0.03 * math.sqrt(2.0) / 200.0)


def test_a_film_without_markers_and_one_that_breaks_off_are_refused(tmp_path: Path) -> None:
    camera = Camera()
    begin_s = (np.arange(12) / camera.rate_hz).tolist()
    blank = [np.full((camera.height, camera.width), 90, np.uint8)] * 12
    path = write_film(tmp_path / "blank.mkv", camera, blank, begin_s)
    with pytest.raises(FileFormatError, match="no picture shows both markers"):
        track_markers(path, 12, make_tag_finder(1, 2), is_grey=True)
    with pytest.raises(UsageError, match="beige"):
        make_dot_finder("beige")
    cut = tmp_path / "cut.mp4"
    whole = write_film(tmp_path / "whole.mp4", camera, blank, begin_s).read_bytes()
    cut.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError, match="cannot be read as a film"):
        read_film(cut)
    for content in (b"", b"#EXTM3U\n/etc/passwd\n", b"<svg xmlns='http://www.w3.org/2000/svg'/>"):
        (tmp_path / "odd.mp4").write_bytes(content)
        with pytest.raises(FileFormatError):
            read_film(tmp_path / "odd.mp4")
    with pytest.raises(FileFormatError, match="no such file"):
        read_film(tmp_path / "gone.mp4")


def test_pictures_have_the_order_of_time_with_b_frames_a_variable_rate_and_a_capture_rate(
    tmp_path: Path,
) -> None:
    camera = Camera(noise=0.0)
    times_s = [0.0, 0.02, 0.04, 0.10, 0.12, 0.14, 0.20, 0.22, 0.24, 0.26]
    pictures = [np.full((camera.height, camera.width), 20 + 20 * i, np.uint8) for i in range(10)]
    path = write_film(tmp_path / "b.mp4", camera, pictures, times_s)
    film, found_s = read_film(path)
    assert film.is_variable
    np.testing.assert_allclose(found_s, times_s, atol=1e-4)
    shown = [
        (index, round(float(p.mean())))
        for index, p in iterate_pictures(path, is_grey=True, begin=3, end=7)
    ]
    assert [index for index, _ in shown] == [3, 4, 5, 6]
    assert np.all(np.diff([grey for _, grey in shown]) > 10)
    slow, slow_s = read_film(path, capture_rate_hz=1000.0)
    assert (slow.capture_rate_hz, slow.rate_hz) == (1000.0, pytest.approx(1000.0))
    assert slow.play_rate_hz == pytest.approx(film.rate_hz)
    np.testing.assert_allclose(slow_s, np.array(times_s) / 20.0, atol=1e-5)
    with pytest.raises(UsageError, match="cannot have been taken"):
        read_film(path, capture_rate_hz=1e9)

"""Angle of a leg in rendered films: tags and dots, codecs, rates, blur, gaps."""

from __future__ import annotations

import math
import struct
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from devices.arrays import Floats
from devices.errors import FileFormatError, UsageError
from service.video import container
from service.video.container import Picture, _compute_rate_hz, iterate_pictures, read_film
from service.video.tracking import (
    Lens,
    calibrate_lens,
    check_area,
    compute_angle,
    make_dot_finder,
    make_tag_finder,
    track_markers,
    undistort,
)
from studies.reproduce.leg_film import LOWER_TAG, UPPER_TAG, Camera, film_leg, write_film
from tests.storage.sessions.test_videos import INFO


def swing(t_s: float) -> float:
    return 0.35 * math.sin(2.0 * math.pi * 0.8 * t_s)


PICTURES = 24
HIDDEN = 12
"""Picture with a hand before the lens."""


@pytest.mark.slow(parts=4)
@pytest.mark.parametrize(
    ("camera", "suffix", "marks"),
    [
        (Camera(), "mp4", "tags"),
        (Camera(codec="libvpx-vp9"), "webm", "dots"),
        (Camera(rate_hz=240.0, exposure=0.8), "mkv", "tags"),
        (Camera(rate_hz=1000.0), "mov", "dots"),
        (Camera(readout=0.6), "mp4", "tags"),
    ],
    ids=["h264-tags", "vp9-dots", "240-blurred", "1000-dots", "rolling-shutter"],
)
def test_the_angle_of_each_picture_is_right_within_what_it_says(
    tmp_path: Path, camera: Camera, suffix: str, marks: str
) -> None:
    generator = np.random.default_rng(7)
    # Every fifth picture was dropped, so the rate is variable.
    begin_s = np.arange(PICTURES * 5 // 4)[np.arange(PICTURES * 5 // 4) % 5 != 3] / camera.rate_hz
    pictures = film_leg(camera, begin_s.tolist(), swing, generator, marks=marks)
    pictures[HIDDEN][:] = 90
    path = write_film(tmp_path / f"film.{suffix}", camera, pictures, begin_s.tolist())
    film, times_s = read_film(path)
    assert film.picture_count == PICTURES
    assert film.is_variable
    np.testing.assert_allclose(times_s, begin_s, atol=1e-3)
    find = (
        make_tag_finder(LOWER_TAG, UPPER_TAG)
        if marks == "tags"
        else make_dot_finder("bright", film)
    )
    places_px = track_markers(path, film, find, is_grey=True)
    angle_rad, sigma_rad = compute_angle(places_px * (1.0, -1.0), zero_rad=0.0)
    # The upper marker, which turns, is at 0.3 of the height: so late is its row.
    late_s = (0.5 * camera.exposure + 0.3 * camera.readout) / camera.rate_hz
    off_deg = np.degrees(angle_rad - [swing(t_s + late_s) for t_s in begin_s])
    assert np.flatnonzero(np.isnan(off_deg)).tolist() == [HIDDEN]
    assert np.nanmax(np.abs(off_deg)) < 0.2
    assert np.sqrt(np.nanmean((off_deg / np.degrees(sigma_rad)) ** 2)) < 1.5


def film_of_greys(path: Path, count: int = 12) -> Path:
    """A film with B-frames whose pictures become brighter; their left upper corner is white."""
    camera = Camera(width=96, height=64)
    pictures = [np.full((64, 96), 20 + 18 * i, np.uint8) for i in range(count)]
    for picture in pictures:
        picture[:20, :20] = 255
    return write_film(path, camera, pictures, [i / 50.0 for i in range(count)])


def test_a_cover_before_the_film_is_not_taken_for_it(tmp_path: Path) -> None:
    path = tmp_path / "film.mkv"
    with av.open(str(path), "w") as container:
        cover = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 192, 128, "yuvj420p"
        stream = container.add_stream("libx264", rate=50)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        image = np.full((128, 192), 200, np.uint8)
        container.mux(cover.encode(av.VideoFrame.from_ndarray(image, format="gray")))
        container.mux(cover.encode(None))
        for i in range(12):
            grey = np.full((64, 96), 20 + 18 * i, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="gray")))
        container.mux(stream.encode(None))
    film, times_s = read_film(path)
    assert (film.codec, film.width_px, len(times_s)) == ("h264", 96, 12)
    assert [index for index, _ in iterate_pictures(path, is_grey=True)] == [*range(12)]


@pytest.mark.parametrize("codec", ["mpeg4", "libx264"])
def test_an_avi_is_read_unless_it_lacks_the_order_of_b_frames(tmp_path: Path, codec: str) -> None:
    for b_frames in (0, 2):
        path = tmp_path / f"{b_frames}.avi"
        with av.open(str(path), "w") as container:
            options = {"bf": str(b_frames), "sc_threshold": "1000000000"}
            stream = container.add_stream(codec, rate=50, options=options)
            assert isinstance(stream, av.VideoStream)
            stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
            for i in range(12):
                grey = np.full((64, 96), 20 + 18 * i, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="gray")))
            container.mux(stream.encode(None))
        if b_frames and codec == "libx264":
            with pytest.raises(FileFormatError, match=r"order .* expected MP4.* ffmpeg -i"):
                read_film(path)
            continue
        assert read_film(path)[0].picture_count == 12
        greys = {index: int(p.mean()) for index, p in iterate_pictures(path, is_grey=True)}
        assert greys == {i: pytest.approx(20 + 18 * i, abs=4) for i in range(12)}


def patch_box(path: Path, name: bytes, offset: int, *numbers: int) -> None:
    """Replace signed numbers behind the name of a box."""
    content = bytearray(path.read_bytes())
    struct.pack_into(f">{len(numbers)}i", content, content.index(name) + offset, *numbers)
    path.write_bytes(content)


def test_an_edit_list_leaves_out_the_pictures_that_no_player_shows(tmp_path: Path) -> None:
    path = film_of_greys(tmp_path / "film.mp4")
    whole = dict(iterate_pictures(path, is_grey=True))
    delay, ticks_per_s = 3600, 90_000  # of the first picture, by B-frames
    patch_box(path, b"elst", 16, delay + ticks_per_s * 3 // 50)
    film, times_s = read_film(path)
    assert film.picture_count == 9
    np.testing.assert_allclose(times_s, np.arange(9) / 50.0, atol=1e-6)
    for index, picture in iterate_pictures(path, is_grey=True):
        np.testing.assert_array_equal(picture, whole[index + 3])


@pytest.mark.parametrize(
    ("begin", "end", "first"), [(0, 20, 0), (25, 60, 25), (24.5, 60, 25), (13, 31, 13)]
)
def test_a_trimmed_film_is_whole_and_a_cut_one_is_not(
    tmp_path: Path, begin: float, end: int, first: int
) -> None:
    """Trimmed as phones do: its edit list leaves out begin and end, which the file still has."""
    path, count = tmp_path / "film.mp4", 60
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=50, options={"bf": "2", "g": "10"})
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for i in range(count):
            grey = np.full((64, 96), 20 + 3 * i, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="gray")))
        container.mux(stream.encode(None))
    delay = 512  # of the first picture, by B-frames, of 256 ticks a picture
    patch_box(path, b"elst", 12, round((end - begin) * 20), delay + round(begin * 256))
    film, times_s = read_film(path)
    assert film.picture_count == end - first
    np.testing.assert_allclose(times_s, np.arange(end - first) / 50.0, atol=1e-6)
    greys = [(index, p.mean()) for index, p in iterate_pictures(path, is_grey=True)]
    assert [index for index, _ in greys] == [*range(end - first)]
    np.testing.assert_allclose([grey for _, grey in greys], 20 + 3 * np.arange(first, end), atol=2)
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - 40)
    with pytest.raises(FileFormatError, match=rf"breaks off after \d+ of {count} pictures"):
        read_film(path)


def test_a_rotated_film_is_upright(tmp_path: Path) -> None:
    path = film_of_greys(tmp_path / "film.mp4")
    one = 1 << 16
    patch_box(path, b"tkhd", 44, 0, one, 0, -one, 0, 0, 64 * one, 0, 1 << 30)
    film, _ = read_film(path)
    assert (film.rotation_deg, film.width_px, film.height_px) == (270, 64, 96)
    _, picture = next(iterate_pictures(path, is_grey=True))
    corners = [int(picture[y, x]) for y, x in ((2, 2), (2, -3), (-3, 2), (-3, -3))]
    assert np.argmax(corners) == 1
    assert picture.shape == (96, 64)


@pytest.mark.parametrize(
    ("ratio", "width_px"), [(Fraction(3, 2), 144), (Fraction(1, 2), 48), (Fraction(5), 96)]
)
def test_pictures_have_square_pixels_as_a_player_shows_them(
    tmp_path: Path, ratio: Fraction, width_px: int
) -> None:
    path = tmp_path / "film.mp4"
    stored = np.full((64, 96), 90, np.uint8)
    stored[:, 48:] = 200
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=50)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.codec_context.sample_aspect_ratio = ratio
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(stored, format="gray")))
        container.mux(stream.encode(None))
    one = 1 << 16
    for turn, shape in (
        ((one, 0, 0, 0, one), (64, width_px)),
        ((0, one, 0, -one, 0), (width_px, 64)),
    ):
        patch_box(path, b"tkhd", 44, *turn, 0, 0, 0, 1 << 30)
        film, _ = read_film(path)
        assert (film.height_px, film.width_px) == shape
        for is_grey in (True, False):
            _, picture = next(iterate_pictures(path, is_grey=is_grey))
            assert picture.shape[:2] == shape
    edge = np.argmax(np.abs(np.diff(picture[:, 32, 0].astype(int))))
    assert edge == pytest.approx(width_px / 2, abs=2)


def tag_film(film: Path, rate: str) -> Path:
    """A copy of a film with a phone's tag of the rate at which it was taken."""
    tagged = film.with_name("tagged.mp4")
    with (
        av.open(str(film), "r") as source,
        av.open(str(tagged), "w", options={"movflags": "use_metadata_tags"}) as target,
    ):
        target.metadata["com.android.capture.fps"] = rate
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.size:
                packet.stream = stream
                target.mux(packet)
    return tagged


@pytest.mark.parametrize(
    ("play_hz", "tag", "factor"),
    [(24.0, "30.0", 1.0), (30.0, "240.0", 0.125), (30.0, "24.0", 1.0), (30.0, "0.5", 60.0)],
)
def test_a_tagged_rate_counts_only_if_the_film_plays_much_slower_or_faster(
    tmp_path: Path, play_hz: float, tag: str, factor: float
) -> None:
    greys = [np.full((64, 96), 20 + 18 * i, np.uint8) for i in range(12)]
    times_s = [i / play_hz for i in range(12)]
    film = write_film(tmp_path / "film.mp4", Camera(width=96, height=64), greys, times_s)
    tagged = tag_film(film, tag)
    info, found_s = read_film(tagged)
    assert info.play_rate_hz == pytest.approx(play_hz, rel=0.01)
    np.testing.assert_allclose(found_s, factor * np.array(times_s), atol=1e-3 * factor)
    stated, stated_s = read_film(tagged, capture_rate_hz=play_hz)
    assert stated.capture_rate_hz == play_hz
    np.testing.assert_allclose(stated_s, times_s, atol=1e-3)


@pytest.mark.parametrize(
    ("intervals_s", "tag", "factor"),
    [
        ([1 / 30] * 12 + [1 / 15] * 28, "30.0", 1.0),  # a phone's, where it became dark
        ([1 / 15] * 38 + [1 / 30] * 2, "30.0", 1.0),
        ([1 / 12, 1 / 17, 1 / 19, 1 / 13] * 10, "30.0", 1.0),
        ([1 / 30] * 20 + [2 / 30] + [1 / 30] * 19, "240.0", 0.125),  # slow motion, one dropped
    ],
    ids=["darker", "dark", "uneven", "dropped"],
)
def test_an_uneven_film_is_slow_motion_only_if_it_has_a_rate_of_its_own(
    tmp_path: Path, intervals_s: list[float], tag: str, factor: float
) -> None:
    times_s = np.cumsum([0.0, *intervals_s])
    greys = [np.full((64, 96), 20 + 5 * i, np.uint8) for i in range(len(times_s))]
    camera = Camera(width=96, height=64)
    film = tag_film(write_film(tmp_path / "film.mp4", camera, greys, times_s.tolist()), tag)
    info, found_s = read_film(film)
    assert info.is_variable
    np.testing.assert_allclose(found_s, factor * times_s, atol=1e-3 * factor)


def test_the_size_of_pictures_as_they_are_decoded_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are shown with a quarter of it: decoding takes the memory of all."""
    path = tmp_path / "film.mp4"
    with av.open(str(path), "w") as target:
        stream = target.add_stream("libx264", rate=50)
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(1, 4)
        grey = np.full((64, 128), 90, np.uint8)
        target.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="gray")))
        target.mux(stream.encode(None))
    assert read_film(path)[0].width_px == 32
    monkeypatch.setattr(container, "_PIXELS_MAX", 128 * 64 - 1)
    with pytest.raises(FileFormatError, match="pictures are too large"):
        read_film(path)


def test_a_film_of_three_pictures_and_a_gap_has_a_rate() -> None:
    assert 0.0 < _compute_rate_hz(np.array([0.0, 1.0, 101.0])) <= 1.0


DRAWN = INFO.model_copy(update={"width_px": 160, "height_px": 120})


def draw_dots(*dots: tuple[int, int, int], colour: tuple[int, int, int]) -> Picture:
    picture = np.full((120, 160, 3), 60, np.uint8)
    for x, y, radius in dots:
        cv2.circle(picture, (x, y), radius, colour, -1)
    return picture


def test_two_dots_of_a_colour_are_found_and_of_three_none() -> None:
    red, blue = (30, 30, 220), (220, 60, 30)
    find = make_dot_finder("red", DRAWN)
    picture = draw_dots((40, 100, 6), (70, 20, 6), (120, 60, 1), colour=red)
    cv2.circle(picture, (130, 100), 12, blue, -1)
    found = find(picture)
    assert found is not None
    np.testing.assert_allclose(found, [[40, 100], [70, 20]], atol=0.3)
    assert find(draw_dots((40, 100, 6), (70, 20, 6), (120, 60, 2), colour=red)) is None
    assert find(draw_dots((40, 100, 6), colour=red)) is None
    assert find(draw_dots((40, 100, 6), (70, 20, 6), colour=blue)) is None
    streak = draw_dots((40, 100, 6), (70, 20, 6), colour=red)
    cv2.line(streak, (5, 5), (150, 9), red, 2)
    found = find(streak)
    assert found is not None
    np.testing.assert_allclose(found, [[40, 100], [70, 20]], atol=0.3)


def test_a_dot_is_as_large_as_before_in_a_part_of_the_picture() -> None:
    """A fiftieth of the film's pictures, not of the part in which dots are looked for."""
    red = (30, 30, 220)
    find = make_dot_finder("red", DRAWN)
    picture = draw_dots((40, 100, 9), (70, 20, 9), colour=red)
    whole = find(picture)
    assert whole is not None
    part = find(picture[:, 20:90])
    assert part is not None
    np.testing.assert_allclose(part, whole - np.array([20.0, 0.0]))
    assert find(draw_dots((40, 100, 9), (70, 20, 12), colour=red)) is None


def test_a_lamp_is_no_dot_but_in_the_area_of_the_dots(tmp_path: Path) -> None:
    camera = Camera()
    begin_s = (np.arange(PICTURES) / camera.rate_hz).tolist()
    generator = np.random.default_rng(7)
    pictures = film_leg(
        camera, begin_s, swing, generator, marks="dots", lamp_at=lambda at_s, _: at_s > begin_s[8]
    )
    path = write_film(tmp_path / "film.mp4", camera, pictures, begin_s)
    film, _ = read_film(path)
    find = make_dot_finder("bright", film)
    whole = track_markers(path, film, find, is_grey=True)
    assert np.flatnonzero(~np.isnan(whole[:, 0, 0])).tolist() == [*range(8)]
    area_px = 40, 0, camera.width - 40, camera.height
    beside = track_markers(path, film, find, is_grey=True, area_px=area_px)
    assert np.isfinite(beside).all()
    np.testing.assert_allclose(beside[:8], whole[:8])
    beyond_px = 41, *area_px[1:]
    check_area(area_px, film, path)
    with pytest.raises(UsageError, match=f"reaches to {camera.width + 1}, {camera.height}"):
        check_area(beyond_px, film, path)


def test_a_checkerboard_gives_the_lens_and_its_distortion_is_removed(tmp_path: Path) -> None:
    camera = Camera(width=320, height=240)
    matrix = np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]])
    squares = np.kron(np.indices((7, 10)).sum(axis=0) % 2, np.ones((40, 40))) * 200 + 30
    board = np.pad(squares.astype(np.uint8), 40, constant_values=230)
    generator, pictures = np.random.default_rng(3), []
    for _ in range(8):
        turn, _ = cv2.Rodrigues(generator.uniform(-0.4, 0.4, 3))
        # From pixels of the board, 400 px wide as 1 unit, to the picture.
        plane = np.column_stack([turn[:, 0], turn[:, 1], [0.0, 0.0, 1.9]])
        to_units = np.array([[1 / 400.0, 0.0, -0.6], [0.0, 1 / 400.0, -0.45], [0.0, 0.0, 1.0]])
        shown = cv2.warpPerspective(board, matrix @ plane @ to_units, (320, 240), borderValue=110)
        pictures.append(np.asarray(shown, dtype=np.uint8))
    times_s = [i / 50.0 for i in range(len(pictures))]
    path = write_film(tmp_path / "board.mp4", camera, pictures, times_s)
    film, _ = read_film(path)
    lens = calibrate_lens(path, 9, 6, film)
    np.testing.assert_allclose(lens.matrix, matrix, atol=15.0)
    with pytest.raises(FileFormatError, match="8 x 6 inner corners is in 0 pictures"):
        calibrate_lens(path, 8, 6, film)
    with pytest.raises(FileFormatError, match="expected 640 x 240"):
        calibrate_lens(path, 9, 6, film.model_copy(update={"width_px": 640}))
    bent = Lens(matrix, np.array([-0.3, 0.1, 0.0, 0.0, 0.0]))
    straight_px = np.array([[[60.0, 200.0], [250.0, 40.0]], [[math.nan] * 2, [100.0, 100.0]]])
    rays = np.concatenate([(straight_px[0] - (160.0, 120.0)) / 300.0, np.ones((2, 1))], axis=1)
    seen_px, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), bent.matrix, bent.distortion)
    places_px = straight_px.copy()
    places_px[0] = seen_px[:, 0]
    assert np.abs(places_px[0] - straight_px[0]).max() > 5.0
    np.testing.assert_allclose(undistort(places_px, bent)[0], straight_px[0], atol=0.02)
    assert np.isnan(undistort(places_px, bent)[1]).any()


def test_a_zero_turns_the_angle_and_no_angle_is_beyond_half_a_turn() -> None:
    ahead, up = 200.0 * math.sin(3.0), 200.0 * math.cos(3.0)
    places = np.array([[[100.0, -300.0], [100.0 + ahead, -300.0 + up]]] * 9)
    assert compute_angle(places, zero_rad=0.1)[0] == pytest.approx(2.9)
    angle_rad, sigma_rad = compute_angle(places, zero_rad=-1.0)
    assert angle_rad == pytest.approx(4.0 - 2.0 * math.pi)
    assert sigma_rad == pytest.approx(0.05 * math.sqrt(2.0) / 200.0)


def make_places(angle_rad: Floats, generator: np.random.Generator) -> Floats:
    upper = 200.0 * np.stack([np.sin(angle_rad), np.cos(angle_rad)], axis=1)
    places = np.stack([np.zeros_like(upper), upper], axis=1)
    return np.asarray(places + generator.normal(0.0, 0.05, places.shape))


def test_another_dot_than_the_legs_has_no_angle() -> None:
    places = make_places(np.full(100, 0.2), np.random.default_rng(1))
    places[40:43, 1] = 200.0, 150.0  # a reflection
    angle_rad, _ = compute_angle(places, zero_rad=0.0)
    assert np.isnan(angle_rad[40:43]).all()
    assert np.isfinite(np.delete(angle_rad, [40, 41, 42])).all()


def test_a_foot_at_rest_does_not_vouch_for_a_moving_one() -> None:
    generator = np.random.default_rng(2)
    truth_rad = np.zeros(1000)
    places = make_places(truth_rad, generator)
    places[900:] += generator.normal(0.0, 2.0, places[900:].shape)
    angle_rad, sigma_rad = compute_angle(places, zero_rad=0.0)
    for part in (slice(0, 900), slice(900, 1000)):
        ratio = np.sqrt(np.mean((angle_rad[part] / sigma_rad[part]) ** 2))
        assert 0.5 < ratio < 1.3


def test_a_noise_that_cannot_be_measured_is_unknown() -> None:
    places = make_places(np.full(60, 0.1), np.random.default_rng(3))
    places[::6] = math.nan
    angle_rad, sigma_rad = compute_angle(places, zero_rad=0.0)
    assert np.isfinite(angle_rad).sum() == 50
    assert np.isnan(sigma_rad).all()


def test_a_film_without_markers_and_one_that_breaks_off_are_refused(tmp_path: Path) -> None:
    camera = Camera()
    begin_s = (np.arange(12) / camera.rate_hz).tolist()
    blank = [np.full((camera.height, camera.width), 90, np.uint8)] * 12
    path = write_film(tmp_path / "blank.mkv", camera, blank, begin_s)
    with pytest.raises(FileFormatError, match="no picture shows both markers"):
        track_markers(path, read_film(path)[0], make_tag_finder(1, 2), is_grey=True)
    with pytest.raises(UsageError, match="beige"):
        make_dot_finder("beige", DRAWN)
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
    assert slow.capture_rate_hz == 1000.0
    assert slow.rate_hz == pytest.approx(1000.0)
    assert slow.play_rate_hz == pytest.approx(film.rate_hz)
    np.testing.assert_allclose(slow_s, np.array(times_s) / 20.0, atol=1e-5)
    for rate_hz in (1e9, 0.0, -1.0, math.nan):
        with pytest.raises(UsageError, match="cannot have been taken"):
            read_film(path, capture_rate_hz=rate_hz)

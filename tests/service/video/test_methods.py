"""Films of a lamp, of the clock page and of steps, aligned with a sealed session."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from devices.errors import FileFormatError, StateError, UsageError
from service.video.alignment import fit_alignment
from service.video.light import compute_mean_code
from service.video.methods import AlignmentOptions, align_video
from service.video.worker import describe_film
from storage.clock.log import ClockOffset
from storage.clock.table import StreamClockFacts, write_clock_file
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.videos import IncomingVideo, Video, find_video_folder, read_video, write_video
from storage.sessions.writer import SealedFileWriter
from studies.reproduce.leg_film import Camera, write_film
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array
from tests.builders.frames import make_frames
from tests.service.video.test_clock_page import Screen, film_screen

MONO_NS = 5_000_000_000_000
"""The node's clock at the session's first frame."""
SESSION_S = 20.0
SERVER_AHEAD_NS = 4_321_000_000
DRIFT = 50e-6
STEPS_S = (6.0, 6.7, 7.3, 8.2, 8.8, 9.6)
SMALL = Camera(rate_hz=50.0, width=96, height=64)
DARK = [np.full((SMALL.height, SMALL.width), 90, np.uint8)] * 400


def make_session(folder: Path, *, lamp: bool = True, server: bool = True) -> Path:
    """A sealed session with a lamp, some steps, and its clock against a server's."""
    folder.mkdir()
    count = round(SESSION_S * 1e9 / PERIOD_NS)
    t_mono_ns = MONO_NS + PERIOD_NS * np.arange(count)
    since_s = 1e-9 * (t_mono_ns - MONO_NS)
    steps = [(since_s >= begin_s) & (since_s < begin_s + 0.3) for begin_s in STEPS_S]
    loaded = np.any(steps, axis=0)
    estimates = {
        "contact": loaded.astype(np.int8),
        "grf_n": np.where(loaded, 20.0, 0.0),
        "grf_sigma_n": np.full(count, 0.1),
        "cop_x_m": np.where(loaded, 0.01, np.nan),
        "cop_sigma_x_m": np.where(loaded, 1e-3, np.nan),
        "estimate_flags": np.zeros(count, np.uint16),
        "part": np.zeros(count, np.uint16),
    }
    sync = {"output_line": 27, "output": "code"} if lamp else {"output_line": 27}
    info = make_array(2, stream_id="a" * 32, utc_offset_ns=UTC_NS)
    with SealedFileWriter(folder / FRAMES_NAME, info, {"scene": {"sync": sync}}) as writer:
        writer.append_frames(make_frames(count, t_mono_ns=t_mono_ns), estimates)
    rows = [
        ClockOffset(
            stream_id=info.stream_id,
            t_mono_ns=MONO_NS + second * 10**9,
            server_minus_node_ns=SERVER_AHEAD_NS,
            uncertainty_ns=1_000_000,
        )
        for second in range(0, 20, 4)
    ]
    if server:
        facts = StreamClockFacts(info.stream_id, UTC_NS, True)
        write_clock_file(folder / "clock.parquet", rows, [facts])
    return folder


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return make_session(tmp_path / "session")


def add_film(session: Path, camera: Camera, pictures: Sequence[npt.NDArray[np.uint8]]) -> Video:
    path = session.parent / "film.mp4"
    times_s = [index / camera.rate_hz for index in range(len(pictures))]
    write_film(path, camera, pictures, times_s)
    with IncomingVideo(session, path.name) as incoming:
        incoming.write(path.read_bytes())
        return incoming.keep(lambda film: describe_film(film, path.name))


def film_lamp(offset_s: float, seconds: float = 8.0) -> list[npt.NDArray[np.uint8]]:
    """A lamp beside a bright thing that moves; blank before and after the session."""
    generator = np.random.default_rng(8)
    film_s = np.arange(round(seconds * SMALL.rate_hz)) / SMALL.rate_hz
    since_s = offset_s + film_s * (1.0 + DRIFT)
    on = compute_mean_code(MONO_NS + 1e9 * since_s, 0.3e9 / SMALL.rate_hz)
    on = np.where((since_s > 0) & (since_s < SESSION_S), on, 0.0)
    pictures = []
    for index, level in enumerate(on.tolist()):
        picture = generator.normal(90.0, 3.0, (SMALL.height, SMALL.width))
        picture[40:60, index % 70 : index % 70 + 20] += 100.0
        picture[20:26, 33:39] += 120.0 * level
        pictures.append(np.clip(np.round(picture), 0, 255).astype(np.uint8))
    return pictures


def measure_error_ns(video: Video, film_s: float, true_s: float) -> tuple[float, float]:
    """Error of an instant of the film against its true one after the session's begin, and sigma."""
    assert video.alignment is not None
    at_s = np.array([film_s])
    found_ns = video.alignment.t_ns - (MONO_NS + UTC_NS)
    found_ns += video.alignment.to_session_ns(at_s)[0]
    return float(found_ns - 1e9 * true_s), float(video.alignment.compute_sigma_ns(at_s)[0])


@pytest.mark.slow(parts=4)
@pytest.mark.parametrize("offset_s", [-2.0, 14.0])
def test_a_film_of_the_lamp_is_aligned_within_half_a_picture(
    session: Path, offset_s: float
) -> None:
    added = add_film(session, SMALL, film_lamp(offset_s))
    video = align_video(session, added.id, "light")
    for film_s in (0.0, 4.0, 8.0):
        off_ns, sigma_ns = measure_error_ns(video, film_s, offset_s + film_s * (1.0 + DRIFT))
        # The lamp of this test is not late, which is at the end of what may be.
        assert abs(off_ns) < 0.5e9 / SMALL.rate_hz
        assert abs(off_ns) < 4.0 * sigma_ns
    assert read_video(find_video_folder(session, added.id)) == video


@pytest.mark.slow(parts=4)
def test_a_film_of_the_clock_page_is_aligned_by_the_servers_time(session: Path) -> None:
    generator = np.random.default_rng(9)
    camera = Camera(rate_hz=30.0, width=640, height=400)
    offset_s, latency_ns = -4.0, 42e6
    server_ns = MONO_NS + UTC_NS + SERVER_AHEAD_NS
    screen = Screen(1e9 / 60, 0.4, latency_ns, true_ns=server_ns + round(1e9 * offset_s))
    pictures = [np.full((400, 640), 120, np.uint8)] * 10
    pictures += [film_screen(screen, k * 1e9 / 30, 20e6, generator) for k in range(10, 60)]
    pictures += [np.full((400, 640), 120, np.uint8)] * 120
    added = add_film(session, camera, pictures)
    video = align_video(session, added.id, "clock")
    off_ns, sigma_ns = measure_error_ns(video, 1.0, offset_s + 1.0 - 0.01)
    assert abs(off_ns) < 3.0 * sigma_ns
    assert 5e6 < sigma_ns < 20e6


def test_picked_touchdowns_are_aligned_with_contacts_within_a_picture(session: Path) -> None:
    added = add_film(session, SMALL, DARK)
    picked = tuple(round((step_s - 5.2) * SMALL.rate_hz) for step_s in STEPS_S)
    options = AlignmentOptions(pictures=picked)
    off_ns, sigma_ns = measure_error_ns(
        align_video(session, added.id, "contact", options), 2.0, 7.2
    )
    assert abs(off_ns) < 1e9 / SMALL.rate_hz
    assert abs(off_ns) < 4.0 * sigma_ns


def test_the_first_picture_of_a_film_is_no_touchdown(session: Path) -> None:
    """It shows a foot that may have stood for long; nothing says when it was put down."""
    added = add_film(session, SMALL, DARK)
    for pictures in ((0,), (0, 40, 75)):
        with pytest.raises(UsageError, match=r"film\.mp4: picture 0 shows no touchdown"):
            align_video(session, added.id, "contact", AlignmentOptions(pictures=pictures))
    assert read_video(find_video_folder(session, added.id)).alignment is None


def test_a_picture_after_dropped_ones_is_as_uncertain_as_they_are(session: Path) -> None:
    times_s = [*np.arange(20) / SMALL.rate_hz, *(0.8 + np.arange(20) / SMALL.rate_hz)]
    path = session.parent / "gap.mp4"
    write_film(path, SMALL, DARK[: len(times_s)], times_s)
    with IncomingVideo(session, path.name) as incoming:
        incoming.write(path.read_bytes())
        added = incoming.keep(lambda film: describe_film(film, path.name))
    sigmas_ns = []
    for picture in (19, 20):
        options = AlignmentOptions(pictures=(picture,), instants_s=(5.0,))
        alignment = align_video(session, added.id, "hand", options).alignment
        assert alignment is not None
        sigmas_ns.append(alignment.sigma_ns)
    ratio = (0.8 - 19 / SMALL.rate_hz) * SMALL.rate_hz
    assert sigmas_ns[1] / sigmas_ns[0] == pytest.approx(ratio, rel=0.05)


def test_what_contradicts_another_method_is_refused_unless_it_replaces_it(
    session: Path,
) -> None:
    added = add_film(session, SMALL, DARK)
    folder = find_video_folder(session, added.id)
    film_s, begin_ns = np.array([1.0, 5.0]), MONO_NS + UTC_NS
    by_light = fit_alignment(
        "light", film_s, 1e9 * (film_s + 3.0), np.full(2, 1e6), begin_t_ns=begin_ns
    )
    write_video(folder, added.model_copy(update={"alignment": by_light}))
    wrong = AlignmentOptions(pictures=(100, 200), instants_s=(5.4, 7.4))
    with pytest.raises(StateError, match=r"400\.\d ms later by hand than by light"):
        align_video(session, added.id, "hand", wrong)
    assert read_video(folder).alignment == by_light
    right = AlignmentOptions(pictures=(100,), instants_s=(5.0,))
    assert align_video(session, added.id, "hand", right).alignment is not None
    corrected = AlignmentOptions(pictures=(100,), instants_s=(6.0,))
    assert align_video(session, added.id, "hand", corrected).alignment is not None
    write_video(folder, added.model_copy(update={"alignment": by_light}))
    with pytest.raises(StateError, match="methods that agree"):
        align_video(session, added.id, "hand", wrong)
    wrong = AlignmentOptions(pictures=(100, 200), instants_s=(5.4, 7.4), replaces=True)
    replaced = align_video(session, added.id, "hand", wrong).alignment
    assert replaced is not None
    assert replaced.pair_count == 2
    for options, match in (
        (AlignmentOptions(), "are missing"),
        (AlignmentOptions(pictures=(400,), instants_s=(1.0,)), "from 0 to 399"),
        (AlignmentOptions(pictures=(1, 2), instants_s=(1.0,)), "needs its instant"),
    ):
        with pytest.raises(UsageError, match=match):
            align_video(session, added.id, "hand", options)


def test_a_film_of_nothing_or_of_another_session_is_refused_with_a_reason(tmp_path: Path) -> None:
    session = make_session(tmp_path / "session")
    video_id = add_film(session, SMALL, DARK).id
    with pytest.raises(FileFormatError, match="no part of the picture blinks"):
        align_video(session, video_id, "light")
    with pytest.raises(FileFormatError, match="no picture shows the clock page"):
        align_video(session, video_id, "clock")
    late = AlignmentOptions(pictures=(0,), instants_s=(21.0,))
    with pytest.raises(FileFormatError, match=r"begins 1\.0 s after the session"):
        align_video(session, video_id, "hand", late)
    early = AlignmentOptions(pictures=(0,), instants_s=(-10.0,))
    with pytest.raises(FileFormatError, match=r"ends 2\.0 s before the session"):
        align_video(session, video_id, "hand", early)
    with pytest.raises(UsageError, match="outside the session"):
        align_video(session, video_id, "light", AlignmentOptions(near_s=1000.0))
    alone = make_session(tmp_path / "alone", lamp=False, server=False)
    video_id = add_film(alone, SMALL, DARK[:20]).id
    with pytest.raises(UsageError, match="no lamp"):
        align_video(alone, video_id, "light")
    with pytest.raises(StateError, match="not compared with a server"):
        align_video(alone, video_id, "clock")

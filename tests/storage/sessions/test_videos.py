"""A video is whole or not there, and its session's other files never change."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, FootTileError, StorageError, UnknownError
from storage.durable_files import remove_dead_process_temporaries
from storage.sessions import videos
from storage.sessions.videos import (
    Alignment,
    FilmInfo,
    IncomingVideo,
    Video,
    find_video_folder,
    find_video_folders,
    get_film_path,
    read_video,
    remove_video,
    verify_videos,
)
from tests.storage.faulty_disk import NO_SPACE, disk_with_room_for, flip_bits, refusing

CONTENT = os.urandom(5000)
INFO = FilmInfo(
    codec="h264",
    width_px=640,
    height_px=480,
    rotation_deg=0,
    picture_count=2,
    duration_s=0.02,
    rate_hz=50.0,
    play_rate_hz=50.0,
    is_variable=False,
    capture_rate_hz=None,
)


TIMES = b'{"film_s": [0.0, 0.02]}\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "session"
    folder.mkdir()
    (folder / "session.json").write_text("{}")
    return folder


def add(folder: Path, name: str = "walk.mp4") -> Video:
    with IncomingVideo(folder, name) as incoming:
        for begin in range(0, len(CONTENT), 1000):
            incoming.write(CONTENT[begin : begin + 1000])
        return incoming.keep(lambda _: (INFO, TIMES))


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_video_is_kept_with_its_hash_and_found_by_its_id(folder: Path) -> None:
    first, second = add(folder), add(folder, "hop.MKV")
    assert (first.size_bytes, first.sha256) == (5000, hashlib.sha256(CONTENT).hexdigest())
    assert [*find_video_folders(folder)] == sorted([first.id, second.id])
    place = find_video_folder(folder, second.id)
    assert read_video(place) == second
    assert get_film_path(place, second) == place / "film.mkv"
    assert get_film_path(place, second).read_bytes() == CONTENT
    remove_video(folder, first.id)
    assert [*find_video_folders(folder)] == [second.id]
    with pytest.raises(UnknownError, match=second.id):
        remove_video(folder, first.id)


@pytest.mark.parametrize("video_id", ["", "..", "../x", "0" * 11, "A" * 12, "\0", "x" * 10_000])
def test_no_id_leads_out_of_the_session(folder: Path, video_id: str) -> None:
    with pytest.raises(UnknownError):
        find_video_folder(folder, video_id)


@pytest.mark.parametrize(
    "name",
    [
        *("../../walk.mp4", "/etc/walk.mp4", "..\\walk.mp4", 'a"b\r\nX: y.mp4', "\x1b[2J.mp4"),
        *("\u202egnp.mp4", "odd\udcff.mp4", "x" * 500 + ".mp4", ".mp4.mp4", "NUL.Mp4"),
    ],
)
def test_a_hostile_name_is_only_shown(folder: Path, name: str) -> None:
    video = add(folder, name)
    assert video.name.isprintable()
    assert video.name.lower().endswith(".mp4")
    assert names(folder) == {"session.json", f"video-{video.id}"}
    assert names(folder / f"video-{video.id}") == {"film.mp4", "times.json", "video.json"}


@pytest.mark.parametrize(
    "name", ["", ".mp4", "walk", "walk.mp4/x", "a.sh", "a.html", "a.m3u8", "x."]
)
def test_another_suffix_is_refused_at_once(folder: Path, name: str) -> None:
    with pytest.raises(FileFormatError, match="no film"):
        IncomingVideo(folder, name)
    assert names(folder) == {"session.json"}


def broken(path: Path) -> tuple[FilmInfo, bytes]:
    raise FileFormatError("no film", where=str(path))


def test_what_is_not_kept_leaves_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(keep: bool = True) -> None:
        with IncomingVideo(folder, "a.mp4", 10) as incoming:
            assert find_video_folders(folder) == {}
            incoming.write(CONTENT)
            if keep:
                incoming.keep(broken)

    with pytest.raises(KeyboardInterrupt), IncomingVideo(folder, "a.mp4"):
        raise KeyboardInterrupt
    with pytest.raises(FileFormatError):
        fill()
    fill(keep=False)
    with disk_with_room_for(1000), pytest.raises(StorageError, match="written"):
        fill()
    monkeypatch.setattr(os, "fdatasync", refusing(*NO_SPACE))
    with pytest.raises(StorageError, match="No space"):
        fill()
    assert names(folder) == {"session.json"}
    assert remove_dead_process_temporaries(folder) == []


@pytest.mark.parametrize("mode", [0o700, 0o750, 0o755])
def test_a_video_is_as_open_as_its_session(folder: Path, mode: int) -> None:
    folder.chmod(mode)
    before = os.umask(0o022)
    try:
        video = add(folder)
    finally:
        os.umask(before)
    assert stat.S_IMODE(find_video_folder(folder, video.id).stat().st_mode) == mode


@pytest.mark.process
def test_what_a_killed_process_left_is_deleted_when_a_video_is_added(folder: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path\n"
        "from storage.sessions.videos import IncomingVideo\n"
        "IncomingVideo(Path(sys.argv[1]), 'a.mp4').__enter__().write(bytes(99)); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", code, str(folder)], check=False)
    assert len(names(folder)) == 2
    with IncomingVideo(folder, "b.mp4"):
        living = names(folder)
        assert len(living) == 2
        video = add(folder)
        assert names(folder) == living | {f"video-{video.id}"}
    assert names(folder) == {"session.json", f"video-{video.id}"}


def test_a_film_leaves_room_for_frames(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = shutil.disk_usage(folder).free
    with pytest.raises(StorageError, match="1024 MiB"), IncomingVideo(folder, "a.mp4", free):
        pytest.fail("it was begun")
    with IncomingVideo(folder, "a.mp4") as incoming:
        incoming.write(CONTENT)
        monkeypatch.setattr(videos, "FREE_BYTES_MIN", 1 << 60)
        with pytest.raises(StorageError, match="no space for the film"):
            incoming.write(CONTENT)
    assert names(folder) == {"session.json"}


def test_a_session_that_is_deleted_meanwhile_is_named(folder: Path) -> None:
    trash = folder.with_name("trash")
    with IncomingVideo(folder, "a.mp4") as incoming:
        incoming.write(CONTENT)
        folder.rename(trash)
        with pytest.raises(UnknownError, match="deleted meanwhile"):
            incoming.write(CONTENT)
        with pytest.raises(UnknownError, match="deleted meanwhile"):
            incoming.keep(lambda _: (INFO, TIMES))
    with pytest.raises(UnknownError), IncomingVideo(folder, "a.mp4"):
        pytest.fail("it was begun")
    assert find_video_folders(trash) == find_video_folders(folder) == {}
    assert not folder.exists()


def test_many_add_and_remove_at_once(folder: Path) -> None:
    errors: list[BaseException] = []

    def work() -> None:
        try:
            for _ in range(10):
                video = add(folder)
                verify_videos(folder)
                remove_video(folder, video.id)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert names(folder) == {"session.json"}


def test_verification_names_each_damage(folder: Path) -> None:
    assert verify_videos(folder) == []
    added = [add(folder, f"{name}.mp4") for name in ("whole", "flip", "cut", "gone", "bad", "none")]
    whole, flip, cut, gone, bad, none = (find_video_folder(folder, video.id) for video in added)
    assert verify_videos(folder) == []
    flip_bits(flip / "film.mp4")
    os.truncate(cut / "film.mp4", 10)
    (gone / "film.mp4").unlink()
    flip_bits(bad / "video.json")
    (none / "video.json").unlink()
    (folder / "video-0123").mkdir()
    said = {line[6:18]: line[20:] for line in verify_videos(folder)}
    assert whole.name[6:] not in said
    assert said[flip.name[6:]] == "flip.mp4 was changed: its SHA-256 is another one"
    assert said[cut.name[6:]] == "cut.mp4 has 10 bytes, not 5000"
    assert said[gone.name[6:]] == "gone.mp4 is missing"
    assert "text does not match its hash" in said[bad.name[6:]]
    assert said[none.name[6:]] == "the video has no description"
    assert len(said) == 5


def test_a_description_cannot_name_another_file(folder: Path) -> None:
    with pytest.raises(ValueError, match="suffix"):
        Video(**add(folder).model_dump() | {"suffix": "/../../../etc/passwd"})


def test_the_instant_of_a_lone_picture_is_known_to_a_second(folder: Path) -> None:
    """It has no interval, by which the exposure of others is bounded."""
    lone = INFO.model_copy(
        update={"picture_count": 1, "duration_s": 0.0, "rate_hz": 0.0, "play_rate_hz": 0.0}
    )
    alignment = Alignment(
        method="hand",
        film_s=0.0,
        t_ns=5,
        drift=0.0,
        sigma_ns=3e6,
        sigma_drift=0.0,
        pair_count=1,
        rejected_count=0,
    )
    video = add(folder).model_copy(update={"film": lone, "alignment": alignment})
    t_ns, sigma_ns = video.place_pictures(np.zeros(1))
    assert t_ns is not None
    assert sigma_ns is not None
    assert t_ns.tolist() == [5]
    np.testing.assert_allclose(sigma_ns, np.hypot(3e6, 1e9 / np.sqrt(12.0)))


def test_a_file_in_place_of_a_video_is_damage(folder: Path) -> None:
    (folder / ("video-" + "0" * 12)).write_text("")
    with pytest.raises(FootTileError):
        read_video(find_video_folder(folder, "0" * 12))
    assert len(verify_videos(folder)) == 1

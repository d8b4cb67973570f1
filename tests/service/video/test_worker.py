"""No film crashes, stops or fills the process that asks about it."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path

import av
import psutil
import pytest

from devices.errors import FileFormatError, FootTileError, MissingExtraError
from service.video import worker
from service.video.worker import check_extra_installed, describe_film
from tests.service.video.short_film import PICTURES, RATE_HZ, short_film
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.process

_TASK = (
    "import os, time; from service.video import worker; "
    "worker._TASKS['read'] = lambda path, **_: ({}); worker.main()"
)
"""Code of a process whose task is this expression."""


@pytest.fixture
def film(tmp_path: Path) -> Path:
    path = tmp_path / "kept.mp4"
    path.write_bytes(short_film())
    return path


@pytest.mark.parametrize(
    ("suffix", "codec"), [(".mp4", "libx264"), (".webm", "libvpx-vp9"), (".mkv", "libx264")]
)
def test_a_whole_film_is_described_and_a_cut_one_refused(
    tmp_path: Path, suffix: str, codec: str
) -> None:
    film, whole = tmp_path / f"film{suffix}", short_film(suffix, codec)
    film.write_bytes(whole)
    info, times_json = describe_film(film, "walk")
    assert len(json.loads(times_json)["film_s"]) == PICTURES
    assert (info.picture_count, info.width_px, info.height_px) == (PICTURES, 64, 48)
    assert info.rate_hz == pytest.approx(RATE_HZ, rel=0.05)
    film.write_bytes(whole[: len(whole) * 2 // 5])
    with pytest.raises(FileFormatError, match=r"walk: the f.* (breaks off after|be read as)"):
        describe_film(film, "walk")


def test_a_film_that_begins_with_its_index_and_is_cut_is_refused(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    with (
        av.open(io.BytesIO(short_film()), "r") as source,
        av.open(str(film), "w", options={"movflags": "faststart"}) as target,
    ):
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.size:
                end = packet.size
                packet.stream = stream
                target.mux(packet)
    describe_film(film, "walk")
    with film.open("r+b") as file:
        file.truncate(film.stat().st_size - end)
    with pytest.raises(FileFormatError, match=r"walk: .*(breaks off after|cannot be decoded)"):
        describe_film(film, "walk")


@pytest.mark.parametrize(
    "text",
    [
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 50004 RTP/AVP 96\n"
        "a=rtpmap:96 H264/90000\n",
        "ffconcat version 1.0\nfile kept.mp4\n",
        "#EXTM3U\n#EXTINF:1,\nkept.mp4\n#EXT-X-ENDLIST\n",
    ],
    ids=["session description", "concatenation", "playlist"],
)
def test_a_text_that_names_other_files_or_addresses_is_no_film(film: Path, text: str) -> None:
    path = film.with_name("film.mov")
    path.write_text(text)
    with pytest.raises(FileFormatError, match="cannot be read as a film"):
        describe_film(path, "walk.mov")


@pytest.mark.parametrize(
    ("act", "said", "kind"),
    [
        ("os.kill(os.getpid(), 11)", "ended with signal 11", FileFormatError),
        ("os._exit(3)", "ended with code 3", FileFormatError),
        ("bytearray(8 << 30)", "needs more than 4 GiB", FileFormatError),
        (
            "open('/dev/null', 'wb') and open(path, 'ab').write(b'x' * 9999)",
            "a bug: .*File too large",
            FootTileError,  # no fault of the film, nor of a state
        ),
    ],
)
def test_a_decoder_that_crashes_is_an_error_that_names_the_film(
    film: Path,
    monkeypatch: pytest.MonkeyPatch,
    act: str,
    said: str,
    kind: type[FootTileError],
) -> None:
    monkeypatch.setattr(worker, "_CODE", _TASK.format(act))
    with pytest.raises(FootTileError, match=said) as caught:
        describe_film(film, "walk.mp4")
    assert type(caught.value) is kind
    assert caught.value.where == "walk.mp4"
    assert film.read_bytes() == short_film()


def test_a_decoder_that_hangs_is_ended(film: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "_CODE", _TASK.format("time.sleep(600)"))
    monkeypatch.setattr(worker, "_SILENT_S_MAX", 1.0)
    before = set(psutil.Process().children())  # such as the tracker of another test's pool
    with pytest.raises(FileFormatError, match="hung for 1"):
        describe_film(film, "walk.mp4")
    assert set(psutil.Process().children()) <= before


def test_a_decoder_ends_with_the_process_that_waits_for_it(film: Path) -> None:
    begun = film.with_name("begun")
    hang = _TASK.format(f"os.mkdir({str(begun)!r}), time.sleep(600)")
    code = (
        "import sys; from pathlib import Path; from service.video import worker\n"
        f"worker._CODE = {hang!r}\n"
        "worker.describe_film(Path(sys.argv[1]), 'x')"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(film)]) as process:
        until(begun.exists)
        children = psutil.Process(process.pid).children()
        process.kill()
    assert len(children) == 1
    _, alive = psutil.wait_procs(children, timeout=PATIENCE_S)
    assert alive == []


def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    check_extra_installed()
    monkeypatch.setattr(worker, "find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"a film needs av.*'foottile\[video\]'"):
        check_extra_installed()

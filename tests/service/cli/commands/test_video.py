"""`foottile video` as a user meets it."""

from __future__ import annotations

import hashlib
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from storage.durable_files import remove_dead_process_temporaries
from tests.service.cli.commands.test_any_value import PLACES
from tests.service.cli.outcome import Run
from tests.service.sessions.crashed import ID, info_of, session, stream
from tests.service.video.short_film import PICTURES, short_film


@pytest.fixture
def folder(run: Run, tmp_path: Path) -> Path:
    """The folder of a sealed session, in the data folder `data`."""
    root = tmp_path / "data"
    stream(root, info_of(), (0, 99), next_seq=100)
    session(root)
    run("recover", root).succeeds()
    return root / "sessions" / ID


@pytest.fixture
def film(tmp_path: Path) -> Path:
    path = tmp_path / "walk.mp4"
    path.write_bytes(short_film())
    return path


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_a_film_is_kept_as_it_is_and_the_session_unchanged(
    run: Run, folder: Path, film: Path
) -> None:
    before = contents(folder)
    added = run("video", "add", ID, film, "--data", "data", "--json").printed()
    assert (added["name"], added["film"]["picture_count"]) == ("walk.mp4", PICTURES)
    assert run("video", "list", folder, "--json").printed()["items"] == [added]
    kept = folder / f"video-{added['id']}" / "film.mp4"
    assert kept.read_bytes() == film.read_bytes() == short_film()
    assert f"{added['id']} walk.mp4: 64 x 48, 0.22 s, 12" in run("video", "list", folder).out
    assert added["film"]["rate_hz"] == pytest.approx(50.0)
    for whole in (folder, "data"):
        run("verify", whole).succeeds()
    run("video", "remove", folder, added["id"]).succeeds()
    assert contents(folder) == before
    run("video", "remove", folder, added["id"]).fails(1, "no video", "it has none")


def test_a_capture_rate_shortens_the_times(run: Run, folder: Path, film: Path) -> None:
    options = ("--capture-rate", 1000, "--json")
    added = run("video", "add", folder, film, *options).printed()
    assert added["film"]["rate_hz"] == pytest.approx(1000.0)
    run("video", "add", folder, film, "--capture-rate", 1e9).fails(2, "walk.mp4", "1e+09")


def test_what_no_decoder_can_read_is_refused_and_leaves_nothing(
    run: Run, folder: Path, tmp_path: Path
) -> None:
    before = contents(folder)
    (tmp_path / "noise.mp4").write_bytes(bytes(range(256)) * 40)
    refused = run("video", "add", folder, tmp_path / "noise.mp4")
    refused.fails(1, "noise.mp4", "expected MP4, MOV")
    assert ".tmp" not in refused.err
    for name, make in PLACES.items():
        if name in ("junk", "no Parquet"):
            continue
        place = tmp_path / f"{name}.mp4"
        make(place)
        refused = run("video", "add", folder, place)
        assert refused.code in (1, 2)
        assert f"{name}.mp4" in refused.err or (name == "hole" and "no space" in refused.err)
    assert contents(folder) == before
    assert {path.name for path in folder.iterdir()} == {*before}


@pytest.mark.process
def test_what_a_killed_add_leaves_is_no_video_and_is_deleted(
    run: Run, folder: Path, tmp_path: Path
) -> None:
    before = contents(folder)
    code = (
        "import sys, time; from pathlib import Path\n"
        "from storage.sessions.videos import IncomingVideo\n"
        "with IncomingVideo(Path(sys.argv[1]), 'slow.mp4') as incoming:\n"
        "    incoming.write(bytes(1000)); print('begun', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert remove_dead_process_temporaries(folder) == []
        assert run("video", "list", folder).out == ""
        process.send_signal(signal.SIGKILL)
    assert run("video", "list", folder).out == ""
    run("verify", folder).succeeds()
    assert contents(folder) != before
    run("recover", "data").succeeds()
    assert {path.name for path in folder.iterdir()} == {*before}


def test_a_film_aligned_by_hand_says_where_it_begins_and_how_surely(
    run: Run, folder: Path, film: Path
) -> None:
    video_id = run("video", "add", folder, film, "--json").printed()["id"]
    align = ("video", "align", folder, video_id)
    told = run(*align, "--by", "hand", "--pair", "2=0.1", "--pair", "10=0.26")
    told.succeeds()
    assert "by hand, begins 0.0600 s after the session, +- " in told.out
    assert "from 2 instants" in told.out
    assert "drift: not measured, 98 ppm are allowed for" in told.out
    again = run(*align, "--by", "hand", "--pair", "2=0.1", "--json").printed()
    assert again["alignment"]["pair_count"] == 1
    assert "aligned by hand" in run("video", "list", folder).out
    run("verify", folder).succeeds()
    run(*align, "--by", "hand", "--pair", "2=0.5").fails(1, "begins", "after the session")
    for options, words in (
        (("--by", "sound"), "light, clock, contact, hand"),
        ((), "--by"),
        (("--by", "light"), "no lamp"),
        (("--by", "light", "--pair", "1=2"), "--pair is for --by hand"),
        (("--by", "contact"), "--picture of each"),
        (("--by", "hand"), "from 0 to 11"),
        (("--by", "hand", "--pair", "12=0.1"), "from 0 to 11"),
        (("--by", "hand", "--pair", "x"), "as 120=3.52"),
        (("--by", "hand", "--pair", "1=inf"), "as 120=3.52"),
        (("--by", "hand", "--pair", "1=0.1", "--tags", "3,7"), "are for --by contact"),
        (("--by", "hand", "--pair", "1=0.1", "--area", "1,2,3,4"), "are for --tags and --dots"),
        (("--by", "contact", "--picture", 3, "--board", "8x6"), "are for --tags and --dots"),
        (("--by", "contact", "--picture", 3, "--lens", "b.mp4"), "are for --tags and --dots"),
        (("--by", "hand", "--pair", "1=0.1", "--near", 2), "--near is for --by light and contact"),
        (("--by", "clock", "--near", 2), "--near is for --by light and contact"),
        (("--by", "light", "--within", 2), "--within is for --near"),
    ):
        run(*align, *options).fails(2, words)

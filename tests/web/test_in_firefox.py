"""The main path once more in Firefox: watch, record, set a marker, stop, look back, download."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.service.fake_node import Play
from tests.tokens import SHARED_TOKEN
from tests.waiting import until
from tests.web.firefox import ENTER, ESCAPE, FIREFOX, RIGHT, Firefox
from tests.web.scripted import Scripted
from tests.web.session_film import (
    RATE_HZ,
    SHOWN,
    TRIMMED,
    added,
    align,
    make_film,
    write_edits,
)

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.in_turn,
    pytest.mark.skipif(
        FIREFOX is None, reason="no Firefox; on Debian: sudo apt-get install firefox-esr"
    ),
]


STILL = "document.querySelector('#film-card[data-still=true]')?.dataset.picture === arguments[0]"
"""An expression: the film stands at this picture."""


@pytest.fixture(scope="module")
def browser_of_all(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Firefox]:
    firefox = Firefox(tmp_path_factory.mktemp("firefox"))
    yield firefox
    firefox.close()


@pytest.fixture
def firefox(browser_of_all: Firefox) -> Iterator[Firefox]:
    """Fails the test if a page complains in its console."""
    browser_of_all.complaints()
    yield browser_of_all
    found = browser_of_all.complaints()
    browser_of_all.open("about:blank")  # cuts a slow drawing short, of which Firefox complains
    assert found == []


def is_drawn(selector: str) -> str:
    """An expression: something is on this canvas, in more than one colour."""
    return f"""(() => {{
      const canvas = document.querySelector("{selector}");
      const all = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
      return new Set(new Uint32Array(all.buffer)).size > 4;
    }})()"""


def test_what_stands_on_the_foot_is_watched_recorded_marked_looked_at_and_downloaded(
    scripted: Scripted, firefox: Firefox
) -> None:
    with Play(scripted.node, 5.0) as play:
        firefox.open(scripted.running.link())
        firefox.wait("document.body.dataset.live === 'true'")
        firefox.wait("Math.abs(Number(document.getElementById('grf').dataset.value) - 10) < 0.01")
        firefox.wait("document.querySelectorAll('#bars [data-value]').length === 2")
        firefox.wait(is_drawn("#trace"))
        play.force_n = 8.0
        firefox.wait("Math.abs(Number(document.getElementById('grf').dataset.value) - 16) < 0.01")

        firefox.find("#session-name").send_keys("in Firefox")
        firefox.click("#record")
        firefox.wait_for_text("#recordings", "in Firefox")
        firefox.find("#marker-label").send_keys("a stone", ENTER)
        firefox.wait_for_text("#notices", "a stone")
        until(lambda: scripted.running.sessions()[0]["frames"] > 600)
        firefox.click("#stop")
        until(lambda: scripted.running.sessions()[0]["state"] == "sealed")

    firefox.click("#to-sessions")
    firefox.click("#sessions a[href^='/sessions/']")
    firefox.wait("document.querySelector('#plots')?.dataset.settled === 'true'")
    firefox.wait(is_drawn("#plots-canvas"))
    firefox.wait_for_text("#markers-list", "a stone")
    firefox.wait("document.getElementById('replay').dataset.waiting === 'false'")
    assert firefox.run("return document.getElementById('plots').dataset.whole") == "true"
    firefox.drag("#plots", (300, 200), (500, 200))
    firefox.wait("document.getElementById('plots').dataset.whole === 'false'")
    firefox.wait("/from=/.test(location.search)")  # the link carries it
    firefox.keys(RIGHT)
    firefox.wait("document.getElementById('readout').dataset.timeS")
    firefox.wait("Math.abs(Number(document.getElementById('grf').dataset.value) - 16) < 0.01")
    first = firefox.wait("document.getElementById('replay').dataset.seq")
    firefox.click("#play")
    firefox.wait("document.getElementById('replay').dataset.seq !== arguments[0]", first)
    firefox.wait("document.getElementById('play').dataset.going === 'false'")  # at its end

    firefox.click("#zoom-all")
    firefox.wait("document.getElementById('plots').dataset.whole === 'true'")
    firefox.click("#download-parquet")
    table = pq.read_table(firefox.downloaded(".parquet"))
    session = scripted.running.sessions()[0]
    assert session["name"] == "in Firefox"
    assert table.num_rows == session["frames"] > 300
    assert (np.diff(table["seq"].to_numpy()) == 1).all()


def test_a_film_is_added_moves_with_the_cursor_and_gives_stills(
    scripted: Scripted, firefox: Firefox, tmp_path: Path
) -> None:
    session = scripted.recorded("walk")
    film = make_film(tmp_path / "walk.webm", "libvpx-vp9")
    firefox.open(f"{scripted.url}/sessions/{session.id}#token={SHARED_TOKEN}")
    firefox.wait("document.querySelector('#plots')?.dataset.settled === 'true'")
    firefox.wait("!document.getElementById('videos-card').hidden")
    firefox.find("#video-file").send_keys(str(film))
    firefox.click("#video-send")
    firefox.wait_for_text("#videos-list", "320 \u00d7 180, 25.0 pictures/s, 2.4 s, vp9")
    firefox.wait_for_text("#film-at", "Picture 1 of 60: 0.000 s of the film, not aligned")
    (video,) = session.running.http.get(f"{session.url}/videos").json()["items"]
    align(session, video, 0.0)
    firefox.open(f"{scripted.url}/sessions/{session.id}?at=0.0")
    for number in range(3):
        firefox.wait(STILL, str(number))
        assert firefox.run(f"return ({SHOWN})()") == number
        firefox.keys(".")
    cursor = "Number(document.getElementById('plots').getAttribute('aria-valuenow'))"
    firefox.wait(f"Math.abs({cursor} - 0.12) < 0.002")
    firefox.drag("#plots", (57, 200), (57, 200))
    firefox.wait(STILL, "0")
    firefox.click("#still-add")
    firefox.wait("document.getElementById('strip-canvas').dataset.stills === '1'")
    firefox.click("#strip-save")
    assert firefox.downloaded(".png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("kind", [*TRIMMED])
def test_each_picture_of_a_trimmed_film_is_the_one_that_the_server_counts(
    scripted: Scripted, firefox: Firefox, tmp_path: Path, kind: str
) -> None:
    session, (edits, shown) = scripted.recorded("walk"), TRIMMED[kind]
    film = write_edits(make_film(tmp_path / f"{kind}.mp4", "libvpx-vp9"), edits)
    video = added(session, film, begin_s=None)
    firefox.open(f"{scripted.url}/sessions/{session.id}#token={SHARED_TOKEN}")
    firefox.wait("document.querySelector('#plots')?.dataset.settled === 'true'")
    for number in (*range(len(shown)), len(shown) // 2, 0):
        firefox.run(
            "const slider = document.getElementById('film-slider'); slider.value = arguments[0];"
            "slider.dispatchEvent(new Event('input'))",
            number,
        )
        firefox.wait(STILL, str(number))
        assert firefox.run(f"return ({SHOWN})()") == shown[number]
    firefox.click("#alignment summary")
    firefox.keys(".", ".", ".", ".")
    firefox.wait(STILL, "4")
    firefox.drag("#plots", (157, 200), (157, 200))
    firefox.wait("document.getElementById('readout').dataset.timeS > 0")
    cursor_s = firefox.run("return Number(document.getElementById('readout').dataset.timeS)")
    firefox.click("#pair-hand")
    firefox.click("#align-pairs")
    firefox.wait_for_text("#alignment-line", "Aligned by hand")
    url = f"{session.url}/videos/{video['id']}"
    found = session.running.http.get(url).json()["alignment"]
    paired_s = 1e-9 * (found["t_ns"] - int(session.column("t_ns")[0]))
    assert paired_s - found["film_s"] == pytest.approx(cursor_s - 4 / RATE_HZ, abs=1e-3)


def test_on_a_phone_nothing_is_wider_than_the_screen(scripted: Scripted, firefox: Firefox) -> None:
    session = scripted.recorded("walk")
    with Play(scripted.node, 5.0):
        firefox.open(scripted.running.link(), 390, 844)
        firefox.wait("document.body.dataset.live === 'true'")
        firefox.wait("document.documentElement.scrollWidth <= innerWidth")
        firefox.keys("?")
        firefox.wait("document.getElementById('help-dialog').open")
        firefox.keys(ESCAPE)
        firefox.wait("!document.getElementById('help-dialog').open")
    firefox.open(f"{scripted.url}/sessions/{session.id}", 390, 844)
    firefox.wait("document.querySelector('#plots')?.dataset.settled === 'true'")
    firefox.wait("document.documentElement.scrollWidth <= innerWidth")


def test_what_a_page_complains_of_is_heard(scripted: Scripted, browser_of_all: Firefox) -> None:
    """Else the tests before this one could not fail for it."""
    browser_of_all.open(scripted.url)
    browser_of_all.complaints()
    browser_of_all.run(
        "console.warn('hm'); setTimeout(() => missing());"
        "document.body.append(Object.assign(document.createElement('script'), {text: 'void 0'}))"
    )
    heard: list[str] = []

    def all_three() -> bool:
        heard.extend(browser_of_all.complaints())
        return len(heard) >= 3

    until(all_three)
    for word in ("hm", "missing is not defined", "Content-Security-Policy"):
        assert any(word in complaint for complaint in heard), heard
    assert len(heard) == 3

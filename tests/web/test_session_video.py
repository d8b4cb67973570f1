"""A film on a session's page: added, aligned by hand, in step with the plots, stills of it."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import pytest
from playwright.sync_api import Page, expect

from tests.service.recording import Recording
from tests.service.running import Running
from tests.waiting import until
from tests.web.pages import DESK, PHONE, OpenPage, complaints_at
from tests.web.session_film import BEGIN_S, BITS, BLOCK_PX, RATE_HZ, SHOWN, added, make_film
from tests.web.session_page import recorded_walk, settled, url_of

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

NAME = "<img src=x onerror=alert(1)> walk.webm"


@pytest.fixture(scope="module")
def session(server: Running) -> Recording:
    return recorded_walk(server)


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_film(tmp_path_factory.mktemp("films") / NAME, "libvpx-vp9")


@pytest.fixture
def videos(session: Recording) -> Any:
    """The address of the session's videos, of which none is left by another test."""
    address = f"{session.url}/videos"
    yield address
    for video in session.running.http.get(address).json()["items"]:
        assert session.running.http.delete(f"{address}/{video['id']}").status_code == 204


def still(page: Page, number: int | None = None) -> int:
    """The number of the picture, once the film stands; it is in the picture, too."""
    card = page.locator("#film-card[data-still=true]")
    if number is not None:
        card = page.locator(f"#film-card[data-still=true][data-picture='{number}']")
    expect(card).to_have_count(1)
    shown = int(card.get_attribute("data-picture") or "-1")
    assert page.evaluate(SHOWN) == shown
    return shown


def cursor_s(page: Page) -> float:
    return float(page.locator("#plots").get_attribute("aria-valuenow") or "nan")


def cursor_text(page: Page) -> str:
    return page.locator("#readout [data-key=time] dd").inner_text()


def is_at(page: Page, at_s: float, within_s: float) -> bool:
    return abs(cursor_s(page) - at_s) < within_s


def put_cursor(page: Page, at_s: float) -> None:
    """Put the cursor on an instant, by the mouse."""
    plots = settled(page)
    plots.evaluate("(plots) => plots.scrollIntoView()")
    box = plots.bounding_box()
    begin_s, end_s = (float(plots.get_attribute(f"data-{name}")) for name in ("from", "to"))
    width = box["width"] - 56 - 12
    page.mouse.click(box["x"] + 56 + width * (at_s - begin_s) / (end_s - begin_s), box["y"] + 150)


def test_a_film_is_added_aligned_by_hand_and_removed(
    session: Recording, videos: str, film: Path, open_page: OpenPage
) -> None:
    page = open_page(url_of(session), 1280, 900)
    settled(page)
    page.hover("#video-upload")
    page.set_input_files("#video-file", film)
    page.click("#video-send")
    row = page.locator("#videos-list li")
    expect(row.locator("strong")).to_have_text(NAME)
    expect(row).to_contain_text("320 \u00d7 180, 25.0 pictures/s, 2.4 s, vp9")
    expect(page.locator("#alignment-line")).to_contain_text("Not aligned")
    still(page, 0)
    expect(page.locator("#film-at")).to_contain_text("Picture 1 of 60: 0.000 s of the film")
    assert page.locator("#videos-card img").count() == 0

    page.click("#alignment summary")
    for number, at_s in ((10, 1.4), (50, 3.0)):
        page.fill("#film-slider", str(number))
        still(page, number)
        put_cursor(page, at_s)
        page.click("#pair-hand")
        paired = page.locator("#pairs li").last.inner_text()
        at = re.match(rf"Picture {number + 1} \u2194 (\d\.\d{{3}} s)", paired)
        assert at is not None, paired
        assert cursor_text(page).startswith(at[1])  # the cursor's own, not of a frame beside it
    expect(page.locator("#pairs li")).to_have_count(2)
    page.click("#pair-contact")  # of the same picture: instead of the pair before
    expect(page.locator("#pairs li").last).to_contain_text("contact at")
    page.click("#pairs li:last-child button")
    expect(page.locator("#pairs li")).to_have_count(1)
    put_cursor(page, 3.0)
    page.click("#pair-hand")
    page.click("#align-pairs")
    line = page.locator("#alignment-line")
    expect(line).to_contain_text("Aligned by hand: the film begins at")
    (video,) = session.running.http.get(videos).json()["items"]
    found = video["alignment"]
    begin_s = (found["t_ns"] - int(session.column("t_ns")[0])) * 1e-9 - found["film_s"]
    assert begin_s == pytest.approx(BEGIN_S, abs=0.02)  # a pixel is 5 ms
    assert 0.02 < 1e-9 * found["sigma_ns"] * 2**0.5 < 0.04  # of each: 2 pictures / sqrt(12)
    assert (found["method"], found["pair_count"]) == ("hand", 2)
    text = line.inner_text().replace("\xa0", " ")
    assert re.search(r"begins at (0\.9|1\.0)\d+ s ± \d\d ms \(95 %\), drift -?\d+", text), text
    assert "from 2 pairs" in text
    page.click("#align-light")
    expect(page.locator("#notices")).to_contain_text("Not done")
    page.click("#align-undo")
    expect(line).to_contain_text("Not aligned")

    page.click("#videos-list [aria-label^=Remove]")
    page.click("#ask-yes")
    expect(row).to_have_count(0)
    expect(page.locator("#film-card")).to_be_hidden()
    assert session.running.http.get(videos).json()["items"] == []


def test_an_upload_shows_its_progress_ends_on_demand_and_tells_why_it_is_refused(
    session: Recording, videos: str, tmp_path: Path, open_page: OpenPage
) -> None:
    page = open_page(url_of(session), *PHONE)
    settled(page)
    page.hover("#video-upload")
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(bytes(4 << 20))
    network = page.context.new_cdp_session(page)
    limits = {"offline": False, "latency": 0, "downloadThroughput": -1}
    network.send("Network.enable")
    network.send("Network.emulateNetworkConditions", {**limits, "uploadThroughput": 1 << 18})
    page.set_input_files("#video-file", broken)
    page.click("#video-send")
    expect(page.locator("#upload-text")).to_contain_text(
        re.compile(r"broken\.mp4: \d+ % of 4.2 MB")
    )
    assert complaints_at(page, PHONE) == []
    page.click("#upload-abort")
    expect(page.locator("#notices")).to_contain_text("Upload aborted")
    expect(page.locator("#upload")).to_be_hidden()
    network.send("Network.emulateNetworkConditions", {**limits, "uploadThroughput": -1})
    page.click("#video-send")
    expect(page.locator("#notices")).to_contain_text("Not done: broken.mp4")
    assert session.running.http.get(videos).json()["items"] == []


@pytest.mark.parametrize("codec", ["libvpx-vp9", "libx264"])
def test_film_and_cursor_move_together(
    session: Recording, videos: str, tmp_path: Path, open_page: OpenPage, codec: str
) -> None:
    name = "walk.webm" if codec == "libvpx-vp9" else "walk.mp4"
    added(session, make_film(tmp_path / name, codec))
    page = open_page(url_of(session, "?at=1.0"), 1280, 900)
    settled(page)
    still(page, 0)
    for at_s in (2.01, 1.33, 3.09):
        put_cursor(page, at_s)
        until(partial(is_at, page, at_s, 0.02))
        expected = round((cursor_s(page) - BEGIN_S) * RATE_HZ)
        still(page, expected)
    page.keyboard.press(".")
    shown = still(page, expected + 1)
    until(lambda: abs(cursor_s(page) - BEGIN_S - shown / RATE_HZ) < 0.002)
    for _ in range(3):
        page.keyboard.press(",")
    still(page, expected - 2)
    until(lambda: abs(cursor_s(page) - BEGIN_S - (expected - 2) / RATE_HZ) < 0.002)
    at = page.locator("#film-at").inner_text().replace("\xa0", " ")
    assert re.fullmatch(rf"Picture {expected - 1} of 60: \d\.\d{{4}} s ± 2\.2 ms \(95 %\)", at), at

    put_cursor(page, 0.3)
    expect(page.locator("#film-card")).to_have_attribute("data-outside", "true")
    expect(page.locator("#film-over")).to_contain_text("it runs from 1.00 s to 3.36 s")
    page.click("#zoom-in")  # a film that leads moves the plots' window, too
    page.click("#zoom-in")
    page.fill("#film-slider", "55")
    still(page, 55)
    until(lambda: float(settled(page).get_attribute("data-to")) > BEGIN_S + 55 / RATE_HZ)
    assert cursor_s(page) == pytest.approx(BEGIN_S + 55 / RATE_HZ, abs=0.002)

    page.click("#zoom-all")
    page.fill("#film-slider", "5")
    still(page, 5)
    page.click("#speeds [data-speed='0.25']")
    page.click("#play")
    until(
        lambda: (
            cursor_s(page) > 0
            and page.locator("#film-card").get_attribute("data-picture") not in ("5", "6", "7")
        )
    )
    assert page.evaluate("document.getElementById('film').playbackRate") == pytest.approx(
        0.25, rel=0.3
    )
    page.click("#play")
    still(page)
    until(lambda: abs(cursor_s(page) - BEGIN_S - still(page) / RATE_HZ) < 0.5 / RATE_HZ + 0.002)


def test_an_alignment_that_contradicts_another_one_replaces_it_only_if_confirmed(
    session: Recording, videos: str, film: Path, open_page: OpenPage
) -> None:
    added(session, film)
    page = open_page(url_of(session, "?at=2.1"), 1280, 900)
    settled(page)
    still(page, round(1.1 * RATE_HZ))
    page.click("#alignment summary")
    page.fill("#film-slider", "0")
    still(page, 0)
    assert cursor_s(page) == 2.1  # they are apart
    page.click("#pair-contact")
    expect(page.locator("#notices")).to_contain_text("no picture before this one shows the foot")
    page.fill("#film-slider", "1")
    still(page, 1)
    page.click("#pair-contact")
    expect(page.locator("#pairs li")).to_contain_text("Picture 2 \u2194 contact at 2.0")
    page.click("#align-pairs")
    expect(page.locator("#ask-dialog")).to_contain_text("Replace alignment")
    assert session.running.http.get(videos).json()["items"][0]["alignment"]["method"] == "hand"
    page.click("#ask-yes")
    expect(page.locator("#alignment-line")).to_contain_text(
        re.compile(r"Aligned by contact: the film begins at (1\.9|2\.0)")
    )
    page.click("#alignment summary")
    still(page, round(0.1 * RATE_HZ) + 1)


def test_a_strip_of_stills_is_one_picture(
    session: Recording, videos: str, film: Path, open_page: OpenPage, tmp_path: Path
) -> None:
    added(session, film)
    page = open_page(url_of(session, "?at=1.0"), 1280, 900)
    settled(page)
    still(page, 0)
    for number in (40, 12, 25):
        page.fill("#film-slider", str(number))
        still(page, number)
        page.click("#still-add")
    expect(page.locator("#strip-canvas")).to_have_attribute("data-stills", "3")
    assert complaints_at(page, DESK, PHONE) == []
    with page.expect_download() as download:
        page.click("#strip-save")
    assert download.value.suggested_filename == f"{session.id}-stills.png"
    picture = cv2.imread(str(download.value.path()), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    assert picture[0, 0] == picture[-1, -1] == 255
    width = picture.shape[1]
    assert width == 1800
    seen = []
    for place in (-1, 0, 1):  # side by side in order of time
        left = width / 2 + place * width / 3 * 0.993 - 160
        row = picture[44 + BLOCK_PX // 2]
        bits = [str(int(row[round(left + (bit + 0.5) * BLOCK_PX)] > 128)) for bit in range(BITS)]
        seen.append(int("".join(bits), 2))
    assert seen == [12, 25, 40]


def test_a_film_that_the_browser_cannot_play_is_said(
    session: Recording, videos: str, tmp_path: Path, open_page: OpenPage
) -> None:
    added(session, make_film(tmp_path / "walk.avi", "libvpx-vp9"), begin_s=None)
    page = open_page(url_of(session), 1280, 900)
    expect(page.locator("#film-problem")).to_contain_text("cannot play vp9 in AVI")
    expect(page.locator("#film-tools")).to_be_hidden()
    expect(page.locator("#videos-list li")).to_have_count(1)
    page.click("#alignment summary")
    page.click("#pair-hand")
    expect(page.locator("#notices")).to_contain_text("does not show the film")
    page.click("#align-clock")
    expect(page.locator("#notices")).to_contain_text("Not done: ")
    expect(page.locator("#notices")).not_to_contain_text("does not show the film")
    assert complaints_at(page, DESK, PHONE) == []


def test_slow_motion_plays_in_the_time_of_the_session(
    session: Recording, videos: str, tmp_path: Path, open_page: OpenPage
) -> None:
    added(session, make_film(tmp_path / "hop.webm", "libvpx-vp9"), capture_rate_hz=250.0)
    page = open_page(url_of(session, "?at=1.0"), 1280, 900)
    settled(page)
    still(page, 0)
    expect(page.locator("#videos-list li")).to_contain_text("250 pictures/s, slow motion, 0.2 s")
    put_cursor(page, 1.1)
    until(lambda: abs(cursor_s(page) - 1.1) < 0.02)
    still(page, round((cursor_s(page) - BEGIN_S) * 250.0))
    page.fill("#film-slider", "2")
    still(page, 2)
    page.click("#speeds [data-speed='0.1']")
    page.click("#play")
    rate = "document.getElementById('film').playbackRate"
    until(
        lambda: (
            0.7 < page.evaluate(rate) < 1.3
            and int(page.get_attribute("#film-card", "data-picture") or 0) > 5
        )
    )
    page.click("#play")
    still(page)

"""A film with an edit list on a session's page: the pictures that it shows, and no hidden ones."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.service.recording import Recording
from tests.service.running import Running
from tests.waiting import until
from tests.web.pages import DESK, PHONE, OpenPage, complaints_at
from tests.web.session_film import (
    BEGIN_S,
    PICTURES,
    RATE_HZ,
    SHOWN,
    TRIMMED,
    added,
    make_film,
    write_edits,
)
from tests.web.session_page import recorded_walk, settled, url_of

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


@pytest.fixture(scope="module")
def session(server: Running) -> Recording:
    return recorded_walk(server)


@pytest.fixture(autouse=True)
def no_videos(session: Recording) -> Iterator[None]:
    """None is left by another test."""
    yield
    for video in session.running.http.get(f"{session.url}/videos").json()["items"]:
        session.running.http.delete(f"{session.url}/videos/{video['id']}")


def wait_for(page: Page, number: int) -> None:
    still = f"#film-card[data-still=true][data-picture='{number}']"
    expect(page.locator(still)).to_have_count(1)


def is_cursor_at(page: Page, at_s: float) -> bool:
    shown_s = float(page.locator("#plots").get_attribute("aria-valuenow") or "nan")
    return abs(shown_s - at_s) < 1e-3


@pytest.mark.parametrize("codec", ["libvpx-vp9", "libx264"])
@pytest.mark.parametrize("kind", [*TRIMMED])
def test_each_picture_is_the_one_that_the_server_counts(
    session: Recording, tmp_path: Path, open_page: OpenPage, kind: str, codec: str
) -> None:
    edits, shown = TRIMMED[kind]
    added(session, write_edits(make_film(tmp_path / f"{kind}.mp4", codec), edits))
    page = open_page(url_of(session, f"?at={BEGIN_S}"), 1280, 900)
    settled(page)
    for number in (*range(len(shown)), len(shown) // 2, 0):
        page.fill("#film-slider", str(number))
        wait_for(page, number)
        assert page.evaluate(SHOWN) == shown[number]
        until(partial(is_cursor_at, page, BEGIN_S + number / RATE_HZ))


def test_what_is_hidden_is_said_and_not_played(
    session: Recording, tmp_path: Path, open_page: OpenPage
) -> None:
    edits, shown = TRIMMED["middle"]
    added(session, write_edits(make_film(tmp_path / "cut.mp4", "libx264"), edits), begin_s=None)
    page = open_page(url_of(session), 1280, 900)
    settled(page)
    hidden = PICTURES - len(shown)
    expect(page.locator("#videos-list li").last).to_contain_text(
        f"trimmed ({hidden} pictures hidden), 1.0 s"
    )
    wait_for(page, 0)
    page.click("#film-play")
    wait_for(page, len(shown) - 1)  # it ends there, though the file does not
    assert page.evaluate(SHOWN) == shown[-1]


def test_a_film_of_which_it_is_unknown_what_browsers_show_is_not_aligned_on_the_page(
    session: Recording, tmp_path: Path, open_page: OpenPage
) -> None:
    twice = write_edits(make_film(tmp_path / "twice.mp4", "libx264"), [(400, 0), (400, 5)])
    video = added(session, twice)
    assert video["film"]["hidden_count"] is None
    page = open_page(url_of(session, "?at=1.2"), 1280, 900)
    settled(page)
    expect(page.locator("#film-problem")).to_contain_text("a browser shows is not known")
    expect(page.locator("#film-at")).to_have_text("Picture 1 of 20: its instant is not known")
    expect(page.locator("#still-add")).to_be_disabled()
    page.click("#alignment summary")
    for button in ("#pair-hand", "#pair-contact"):
        page.click(button)
        expect(page.locator("#notices")).to_contain_text("this browser shows is not known")
    expect(page.locator("#pairs li")).to_have_count(0)
    assert complaints_at(page, DESK, PHONE) == []

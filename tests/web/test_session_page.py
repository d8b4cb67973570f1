"""The page of one session: what it is, while it is recorded and after, and how large it is."""

from __future__ import annotations

import re

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from tests.service.fake_node import FakeNode, Play
from tests.service.recording import Recording
from tests.service.running import Running
from tests.waiting import until
from tests.web.pages import DESK, LIVE, PHONE, SMALL_PHONE, OpenPage, complaints, complaints_at
from tests.web.received import Received
from tests.web.scripted import Scripted
from tests.web.session_page import LABEL, LOST, grf, recorded_walk, settled, summary, url_of

pytestmark = pytest.mark.real_time


@pytest.fixture(scope="module")
def walk(server: Running) -> Recording:
    return recorded_walk(server)


@pytest.fixture(scope="module")
def raw(server: Running) -> Recording:
    """A session of an array that nobody calibrated."""
    node = FakeNode(server, "raw", calibration=None)
    node.connect()
    node.send(10)
    node.taken_in()
    session = node.record(name="raw")
    node.deliver(300, [0.0, 30.0], alive=True)
    node.finish(session)
    node.close()
    return session


@pytest.fixture(scope="module")
def twice(server: Running) -> Recording:
    """A session over which the node was switched off and on again."""
    node = FakeNode(server, "twice")
    node.connect()
    node.tared()
    session = node.record(name="twice")
    node.deliver(200, [20.0, 60.0], alive=True)
    node.restart()
    node.come_back()
    node.next_t_mono_ns = node.before[0].sent[-1].t_mono_ns[-1] + 500_000_000
    node.deliver(200, [20.0, 60.0], alive=True)
    node.finish(session)
    node.close()
    assert len(session.now()["parts"]) == 2
    return session


def test_the_page_says_what_the_session_is_and_what_is_drawn(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(walk))
    expect(page.locator("h1")).to_have_text("walk")
    about = page.locator("#about")
    frames = f"{int(walk.now()['frames']):,}"
    for fact in ("bench", "leg 2", "#wet", "Tared", frames, " of 500 frames/s"):
        expect(about).to_contain_text(fact)
    expect(page.locator("header")).to_contain_text("40 frames: link down longer")
    plots = settled(page)
    assert (plots.get_attribute("data-panels") or "").split()[:3] == ["grf", "tile-0", "tile-1"]
    legend = page.locator("#legend")
    expect(legend.locator("[data-kind=lost]")).to_have_text("frames lost")
    expect(legend.locator("[data-kind=saturated]")).to_contain_text("tile saturated")
    assert summary(page, "missing") == LOST
    expect(page.locator("#markers-list")).to_contain_text(LABEL)
    since_s, _ = grf(walk)
    marker_s = page.locator("#markers-list li").get_attribute("data-time-s")
    assert float(marker_s or "nan") == pytest.approx(since_s[700], abs=1e-4)
    # Where nothing is wrong nothing is drawn to be.
    page.goto(url_of(walk, "?from=0.5&to=1.5"))
    settled(page)
    expect(legend.locator("[data-kind=stance]")).to_have_count(1)
    expect(legend.locator("[data-kind=lost]")).to_have_count(0)
    expect(legend.locator("[data-kind=saturated]")).to_have_count(0)


def test_where_the_node_was_started_again_is_shown(twice: Recording, open_page: OpenPage) -> None:
    page = open_page(url_of(twice))
    plots = settled(page)
    expect(page.locator("#legend [data-kind=restarted]")).to_have_count(1)
    expect(page.locator("#about")).to_contain_text("Parts")
    t_ns = twice.column("t_ns")
    gap = int(np.argmax(np.diff(t_ns)))
    before_s, after_s = (t_ns[gap : gap + 2] - t_ns[0]) * 1e-9
    assert after_s - before_s > 0.1
    page.goto(url_of(twice, f"?from={before_s - 0.1}&to={before_s - 0.01}"))
    settled(page)
    expect(plots).to_have_attribute("data-kinds", "")
    page.goto(url_of(twice, f"?from={before_s - 0.1}&to={after_s + 0.1}"))
    expect(plots).to_have_attribute("data-kinds", "restarted")


def test_without_estimates_raw_counts_are_plotted(raw: Recording, open_page: OpenPage) -> None:
    page = open_page(url_of(raw))
    plots = settled(page)
    expect(plots).to_have_attribute("data-panels", "tile-0 tile-1")
    expect(page.locator("#summary")).to_contain_text("no estimates, raw counts")
    expect(page.locator("#replay-lag")).to_contain_text("No forces: the node had no calibration")
    expect(page.locator("#replay-foot")).to_be_hidden()
    page.keyboard.press("ArrowRight")
    expect(page.locator("#readout [data-key=tile-1]")).to_contain_text(
        re.compile("4[67][0-9] counts")
    )


def test_a_session_is_shown_while_it_is_recorded_and_as_it_was_sealed_afterwards(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node):
        session = scripted.node.record(name="now")
        page = open_page(f"{scripted.url}/sessions")
        page.click('#sessions [data-part="open"]')
        expect(page.locator("#message")).to_contain_text("Recording")
        expect(page.locator("#message")).to_contain_text("provisional")
        settled(page)
        until(lambda: summary(page, "frames") >= 100)
        before = summary(page, "frames")
        until(lambda: summary(page, "frames") > before)
        expect(page.locator("#replay-lag")).to_contain_text("Provisional forces")
        expect(page.locator("#download-parquet")).to_be_hidden()
        page.click("#ledger-card summary")
        expect(page.locator("#ledger")).to_contain_text("Not sealed yet")
        expect(page.locator("#verify")).to_be_hidden()
        scripted.running.http.post(f"{session.url}/markers", json={"label": "a stone"})
        expect(page.locator("#markers-list")).to_contain_text("a stone")
        page.keyboard.press("ArrowRight")
        expect(page.locator("#grf")).not_to_have_attribute("data-value", "")
        assert complaints(page) == []
        session.stop()
        session.sealed()
    expect(page.locator("#message")).to_be_hidden()
    expect(page.locator("body")).to_have_attribute("data-state", "sealed")
    settled(page)
    assert summary(page, "frames") == session.now()["frames"]
    assert summary(page, "missing") == 0
    expect(page.locator("#replay-lag")).to_contain_text("Stored forces")
    expect(page.locator("#download-parquet")).to_be_visible()
    page.click("#back")
    expect(page.locator("#sessions")).to_contain_text("now")


def test_each_page_is_small_as_sent_and_the_live_page_does_not_carry_the_other(
    walk: Recording, browser: Browser
) -> None:
    with browser.new_context() as context:
        page = context.new_page()
        received = Received(page)
        page.goto(url_of(walk))
        settled(page)
        page.locator("#overlay-card").scroll_into_view_if_needed()  # all that it ever loads
        expect(page.locator("#overlay-legend")).to_contain_text("mean")
        received.wait_for("/data")
        assert len(received.bytes_of) > 15
        numbers = ("/timeseries", "/stances/overlay")
        bins = sum(
            size for url, size in received.bytes_of.items() if url.split("?")[0].endswith(numbers)
        )
        assert 0 < bins < 300_000
        frames = sum(size for url, size in received.bytes_of.items() if "/data" in url)
        assert 0 < frames < 300_000
        of_page = received.bytes_of_files
    node = FakeNode(walk.running, "weighed")
    node.connect()
    node.tared()
    with browser.new_context() as context, Play(node):
        page = context.new_page()
        received = Received(page)
        page.goto(walk.running.url)
        expect(page.locator(LIVE)).to_have_count(1)
        expect(page.locator("#last-session")).to_contain_text("Not recording")
        received.wait_for("/history")
        assert sum(received.bytes_of_files.values()) < 120_000, received.bytes_of_files
        more = {url: size for url, size in of_page.items() if url not in received.bytes_of}
        assert 0 < sum(more.values()) < 100_000, more
        assert not [u for u in received.bytes_of if "/session/" in u or "session.css" in u]
    node.close()


def test_a_session_that_is_not_there_is_said_not_to_be(
    server: Running, open_page: OpenPage
) -> None:
    page = open_page(f"{server.url}/sessions/none")
    expect(page.locator("#message")).to_contain_text("Session not found")
    expect(page.locator("#message")).to_contain_text("in the trash")
    page.click("#back")
    expect(page.locator("#sessions-card")).to_be_visible()


def test_axe_has_nothing_to_complain_of_and_nothing_is_wider_than_the_screen(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(walk, "?from=1&to=1.1"), *SMALL_PHONE)
    settled(page)
    page.keyboard.press("ArrowRight")
    page.click("#numbers-card summary")
    expect(page.locator("#numbers-rows tr").nth(11)).to_be_attached()
    page.locator("#overlay-card").scroll_into_view_if_needed()
    expect(page.locator("#overlay-legend")).to_contain_text("mean")
    assert complaints_at(page, SMALL_PHONE, PHONE, DESK) == []


def test_an_answer_that_breaks_off_is_as_if_there_were_none(
    walk: Recording, open_page: OpenPage
) -> None:
    broken = {"**/comparisons": lambda route: route.fulfill(body='{"items": [', status=200)}
    page = open_page(url_of(walk), answers=broken)
    settled(page)
    expect(page.locator("#compare")).to_be_visible()

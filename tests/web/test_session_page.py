"""The page of one session: its plots at every zoom, cursor, keys, stances, and what waits."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from playwright.sync_api import Browser, Page, expect

from storage.formats.written.registry import FORMATS
from tests.service.fake_node import FakeNode, Play
from tests.service.recording import Recording
from tests.service.running import Running
from tests.web.conftest import wait_until
from tests.web.received import Received
from tests.web.scripted import Scripted
from tests.web.test_accessible import complaints

pytestmark = pytest.mark.real_time

OpenPage = Callable[..., Page]

LOST = 40
LABEL = "a <b>stone</b>"


@pytest.fixture(scope="module")
def walk(server: Running) -> Recording:
    """Six stances of 80 N, one frame of 90 N, a saturated tile, and forty frames that are lost."""
    node = FakeNode(server)
    node.connect()
    node.tared()
    session = node.record(name="walk", subject="leg 2", tags=["wet"], notes="slow")
    for _ in range(6):
        node.send(200, [0.0, 0.0], alive=True)
        node.send(200, [20.0, 60.0], alive=True)
    node.send(1, [20.0, 70.0])
    node.send(200, [0.0, 0.0], alive=True)
    node.send(50, [20.0, 200.0], alive=True)
    node.send(200, [0.0, 0.0], alive=True)
    first = node.seq
    node.frames(LOST)
    node.say_lost(evicted=[[first, first + LOST - 1]])
    node.deliver(200, [0.0, 0.0], alive=True)
    node.finish(session)
    t_ns = int(session.column("t_ns")[700])
    answer = server.http.post(f"{session.url}/events", json={"label": LABEL, "t_ns": t_ns})
    assert answer.status_code == 201
    node.close()
    return session


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


@pytest.fixture(scope="module")
def live_page(server: Running, browser: Browser) -> Iterator[Page]:
    """Any page of the server, to ask modules something."""
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(server.url)
        yield page


def url_of(session: Recording, query: str = "") -> str:
    return f"{session.running.url}/sessions/{session.id}{query}"


def settled(page: Page) -> Any:
    """The plots, once all bins of the view have come."""
    plots = page.locator("#plots[data-settled=true]")
    expect(plots).to_have_count(1)
    return plots


def seen(page: Page) -> tuple[float, float]:
    plots = settled(page)
    return float(plots.get_attribute("data-from")), float(plots.get_attribute("data-to"))


def summary(page: Page, name: str) -> float:
    return float(page.locator("#summary").get_attribute(f"data-{name}") or "nan")


def grf(session: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Seconds after the first frame, and the GRF, by the sealed file alone."""
    table = pq.read_table(session.folder / "frames.parquet", columns=["t_ns", "grf_n"])
    t_ns = table["t_ns"].to_numpy()
    return (t_ns - t_ns[0]) * 1e-9, table["grf_n"].to_numpy().astype(float)


@pytest.mark.parametrize(
    "query", ["", "?from=0.5&to=4.1", "?from=4.6&to=5.1", "?from=4.79&to=4.83", "?from=1.85&to=1.9"]
)
def test_no_peak_hides_at_any_zoom(walk: Recording, open_page: OpenPage, query: str) -> None:
    page = open_page(url_of(walk, query))
    since_s, grf_n = grf(walk)
    begin_s, end_s = seen(page)
    first_s, last_s = summary(page, "first-s"), summary(page, "last-s")
    in_bin = int(page.locator("#plots").get_attribute("data-frames-in-bin") or 0)
    # Bins at the edges reach a little beyond what is in view.
    assert begin_s - 0.002 * in_bin <= first_s <= begin_s + 0.002
    assert end_s - 0.002 <= last_s <= end_s + 0.002 * in_bin
    inside = (since_s >= first_s - 1e-6) & (since_s <= last_s + 1e-6)
    assert summary(page, "frames") == inside.sum()
    assert summary(page, "grf-max") == pytest.approx(np.nanmax(grf_n[inside]), abs=1e-5)
    assert summary(page, "grf-min") == pytest.approx(np.nanmin(grf_n[inside]), abs=1e-5)


def test_the_page_says_what_the_session_is_and_what_is_drawn(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(walk))
    expect(page.locator("h1")).to_have_text("walk")
    about = page.locator("#about")
    for fact in ("bench", "leg 2", "#wet", f"{int(walk.now()['frames']):,}"):
        expect(about).to_contain_text(fact)
    expect(page.locator("header")).to_contain_text("40 frames: the link was down for longer")
    plots = settled(page)
    assert (plots.get_attribute("data-panels") or "").split()[:3] == ["grf", "tile-0", "tile-1"]
    legend = page.locator("#legend")
    expect(legend.locator("[data-kind=lost]")).to_have_text("frames lost")
    expect(legend.locator("[data-kind=saturated]")).to_contain_text("a tile is saturated")
    assert summary(page, "missing") == LOST
    expect(page.locator("#marks-list")).to_contain_text(LABEL)
    since_s, _ = grf(walk)
    mark_s = page.locator("#marks-list li").get_attribute("data-time-s")
    assert float(mark_s or "nan") == pytest.approx(since_s[700], abs=1e-4)
    # Where nothing is wrong nothing is drawn to be.
    page.goto(url_of(walk, "?from=0.5&to=1.5"))
    settled(page)
    expect(legend.locator("[data-kind=stance]")).to_have_count(1)
    expect(legend.locator("[data-kind=lost]")).to_have_count(0)
    expect(legend.locator("[data-kind=saturated]")).to_have_count(0)


def test_what_is_shown_is_in_the_link_and_comes_back_with_it(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(walk))
    all_s = seen(page)
    box = page.locator("#plots").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 300, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 600, box["y"] + 100, steps=4)
    page.mouse.up()
    expect(page).to_have_url(re.compile(r"\?from=[0-9.]+&to=[0-9.]+$"))
    chosen = seen(page)
    assert 0 < chosen[0] < chosen[1] < all_s[1]
    again = open_page(page.url)
    assert seen(again) == pytest.approx(chosen, abs=1e-3)
    again.mouse.move(box["x"] + 400, box["y"] + 100)
    again.mouse.wheel(0, -300)
    expect(again.locator("#plots")).not_to_have_attribute("data-from", f"{chosen[0]:.4f}")
    closer = seen(again)
    assert chosen[0] < closer[0] < closer[1] < chosen[1]
    again.mouse.dblclick(box["x"] + 400, box["y"] + 100)
    expect(again).to_have_url(url_of(walk))
    assert seen(again) == all_s


def test_keys_zoom_move_the_cursor_and_show_all(walk: Recording, open_page: OpenPage) -> None:
    page = open_page(url_of(walk))
    all_s = seen(page)
    for _ in range(9):
        page.keyboard.press("+")
    expect(page).to_have_url(re.compile("from="))
    close = seen(page)
    assert close[1] - close[0] < (all_s[1] - all_s[0]) / 30
    page.keyboard.press("-")
    wider = seen(page)
    assert close[1] - close[0] < wider[1] - wider[0] < all_s[1]
    since_s, grf_n = grf(walk)
    readout = page.locator("#readout")
    page.keyboard.press("ArrowRight")
    expect(readout).not_to_have_attribute("data-time-s", "")
    for key, by in (("ArrowRight", 1), ("ArrowRight", 1), ("ArrowLeft", -1)):
        before_s = float(readout.get_attribute("data-time-s") or "nan")
        at = int(np.argmin(np.abs(since_s - before_s)))
        page.keyboard.press(key)
        expect(readout).not_to_have_attribute("data-time-s", str(before_s))
        after_s = float(readout.get_attribute("data-time-s") or "nan")
        assert after_s == pytest.approx(since_s[at + by], abs=1e-6)
        shown = f"{grf_n[at + by]:.1f} N"
        expect(readout.locator("[data-key=grf]")).to_contain_text(shown)
        expect(page.locator("#plots")).to_have_attribute("aria-valuetext", re.compile(shown))
    page.keyboard.press("Home")
    expect(page).to_have_url(url_of(walk))
    assert seen(page) == all_s


def test_whole_stances_lie_one_upon_another_and_a_click_on_one_goes_there(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(walk))
    canvas = page.locator("#overlay-canvas")
    canvas.scroll_into_view_if_needed()
    says = page.locator("#overlay-says")
    expect(says).to_contain_text("6 whole stances")
    expect(says).to_contain_text("1 stance not seen whole is left out")
    box = canvas.bounding_box()
    assert box is not None
    at = page.locator("#overlay-at")
    expect(at).to_contain_text("The mean is greatest")
    overlay = walk.running.http.get(f"{walk.url}/stances/overlay").json()
    half = overlay["points"] // 2
    for down in range(0, int(box["height"]), 6):  # from above: some curve is met
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + down)
        page.evaluate("new Promise(requestAnimationFrame)")
        if (at.text_content() or "").startswith("Stance"):
            break
    found = re.match(r"Stance (\d+): ([0-9.]+) N at (\d+) %", at.text_content() or "")
    assert found is not None
    curve = next(one for one in overlay["curves"] if one["number"] == int(found[1]))
    assert abs(int(found[3]) - half) <= 4
    assert float(found[2]) == pytest.approx(curve["grf_n"][int(found[3])], abs=0.06)
    page.mouse.down()
    page.mouse.up()
    gone_to = page.locator("#stances-rows [aria-current]")
    expect(gone_to).to_have_attribute("data-stance", found[1])
    legend = page.locator("#overlay-legend")
    expect(legend).to_have_attribute("data-chosen", found[1])
    expect(legend).to_contain_text(f"stance {found[1]}, frame by frame")
    page.locator("#stances-rows tr").nth(6).click()  # saturated: it has no place among them
    expect(legend).to_contain_text("stance 7 was not seen whole")


def test_paths_of_the_centre_of_pressure_are_coloured_by_time_or_by_stance(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(walk))
    canvas = page.locator("#cop-canvas")
    canvas.scroll_into_view_if_needed()
    expect(canvas).to_have_attribute("data-plan", "false")  # two tiles in a line
    expect(page.locator("#cop-title")).to_contain_text("along the foot")
    legend = page.locator("#cop-legend")
    expect(legend).to_contain_text("first contact to lift-off")
    page.locator("#stances-rows tr").nth(1).click()
    expect(legend).to_contain_text("ends: stance 2")
    by_time = canvas.screenshot()
    page.get_by_role("button", name="stance", exact=True).click()
    expect(legend).to_contain_text("first stance to last stance")
    assert canvas.screenshot() != by_time


def test_a_mark_is_set_at_the_cursor_and_what_is_in_view_can_be_downloaded(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(walk, "?from=1&to=1.2"))
    settled(page)
    page.keyboard.press("ArrowRight")
    readout = page.locator("#readout")
    expect(readout).to_have_attribute("data-time-s", re.compile("."))
    at_s = readout.get_attribute("data-time-s")
    page.fill("#new-mark-label", "here")
    page.press("#new-mark-label", "Enter")
    expect(page.locator("#notices")).to_contain_text("Marked “here”")
    events = walk.running.http.get(f"{walk.url}/events").json()["items"]
    t_ns = next(event["t_ns"] for event in events if event["label"] == "here")
    since_s = (t_ns - int(walk.column("t_ns")[0])) * 1e-9
    assert since_s == pytest.approx(float(at_s or "nan"), abs=1e-5)
    with page.expect_download() as download:
        page.click("#download-csv")
    lines = download.value.path().read_text("utf-8").splitlines()
    assert len([line for line in lines if not line.startswith("#")]) == 101
    page.click("#downloads-more summary")
    offered = page.locator("#download-list [data-format]")
    names = offered.evaluate_all("items => items.map((item) => item.dataset.format)")
    assert set(names) == set(FORMATS) - {"parquet", "arrow", "csv"}
    with page.expect_download() as further:
        page.click("#download-xdf")
    assert further.value.suggested_filename == f"{walk.id}.xdf"
    assert further.value.path().read_bytes().startswith(b"XDF:")
    with page.expect_download() as picture:
        page.click("#picture")
    assert picture.value.path().read_bytes().startswith(b"\x89PNG")


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


@pytest.mark.parametrize(
    ("time_s", "step", "said"),
    [
        (0.0, 0.001, "0.000 s"),
        (59.99, 0.01, "59.99 s"),
        (59.999, 0.01, "1:00.00 min"),
        (75.123, 0.001, "1:15.123 min"),
        (119.999, 0.01, "2:00.00 min"),
        (3600.0, 20.0, "60:00 min"),
        (70.0, 10.0, "1:10 min"),
    ],
)
def test_instants_are_said_with_the_unit_that_they_are_in(
    live_page: Page, time_s: float, step: float, said: str
) -> None:
    code = "async ([t, s]) => (await import('/static/session/overlay.js')).timeWords(t, s)"
    assert live_page.evaluate(code, [time_s, step]) == said


def test_without_estimates_raw_counts_are_plotted(raw: Recording, open_page: OpenPage) -> None:
    page = open_page(url_of(raw))
    plots = settled(page)
    expect(plots).to_have_attribute("data-panels", "tile-0 tile-1")
    expect(page.locator("#summary")).to_contain_text("these are raw counts")
    expect(page.locator("#replay-lag")).to_contain_text("no forces: the node had no calibration")
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
        page = open_page(scripted.url)
        page.click('#sessions [data-part="open"]')
        expect(page.locator("#message")).to_contain_text("still being recorded")
        expect(page.locator("#message")).to_contain_text("provisional")
        settled(page)
        wait_until(lambda: summary(page, "frames") >= 100, "the first frames")
        before = summary(page, "frames")
        wait_until(lambda: summary(page, "frames") > before, "more of them")
        expect(page.locator("#replay-lag")).to_contain_text("Provisional forces")
        expect(page.locator("#download-parquet")).to_be_hidden()
        scripted.running.http.post(f"{session.url}/events", json={"label": "a stone"})
        expect(page.locator("#marks-list")).to_contain_text("a stone")
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
    expect(page.locator("#replay-lag")).to_contain_text("as they are stored")
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
        numbers = ("/overview", "/stances/overlay")
        bins = sum(
            size for url, size in received.bytes_of.items() if url.split("?")[0].endswith(numbers)
        )
        assert 0 < bins < 300_000
        frames = sum(size for url, size in received.bytes_of.items() if "/data" in url)
        assert 0 < frames < 300_000
        of_page = {url: size for url, size in received.bytes_of.items() if "/api/" not in url}
    node = FakeNode(walk.running, "weighed")
    node.connect()
    node.tared()
    with browser.new_context() as context, Play(node):
        page = context.new_page()
        received = Received(page)
        page.goto(walk.running.url)
        expect(page.locator("body")).to_have_attribute("data-live", "true")
        expect(page.locator("#sessions")).to_contain_text("walk")
        received.wait_for("/recent")
        assert received.bytes_in_all < 120_000, received.bytes_of
        more = {url: size for url, size in of_page.items() if url not in received.bytes_of}
        assert 0 < sum(more.values()) < 100_000, more
        assert not [u for u in received.bytes_of if "/session/" in u or "session.css" in u]
    node.close()


def test_a_session_that_is_not_there_is_said_not_to_be(server: Running, browser: Browser) -> None:
    with browser.new_context() as context:  # its console says 404, and is right
        page = context.new_page()
        page.goto(f"{server.url}/sessions/none")
        expect(page.locator("#message")).to_contain_text("There is no such session")
        expect(page.locator("#message")).to_contain_text("in the trash")
        page.click("#back")
        expect(page.locator("#sessions-card")).to_be_visible()


@pytest.mark.parametrize("size", [(390, 844), (320, 640), (1366, 768)])
def test_axe_has_nothing_to_complain_of_and_nothing_is_wider_than_the_screen(
    walk: Recording, open_page: OpenPage, size: tuple[int, int]
) -> None:
    page = open_page(url_of(walk, "?from=1&to=1.1"), *size)
    settled(page)
    page.keyboard.press("ArrowRight")
    page.click("#numbers-card summary")
    expect(page.locator("#numbers-rows tr").nth(11)).to_be_attached()
    page.locator("#overlay-card").scroll_into_view_if_needed()
    expect(page.locator("#overlay-legend")).to_contain_text("mean")
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    assert complaints(page) == []

"""The plots of a session's page: true at any zoom, moved by keys and clicks, and in the link."""

from __future__ import annotations

import re

import numpy as np
import pytest
from playwright.sync_api import Route, expect

from storage.formats.writers.registry import FORMATS
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running
from tests.waiting import until
from tests.web.pages import OpenPage, blue_px, box_of, complaints_at
from tests.web.session_page import grf, left_px, recorded_walk, seen, settled, summary, url_of

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


@pytest.fixture(scope="module")
def walk(server: Running) -> Recording:
    return recorded_walk(server)


@pytest.mark.parametrize(
    "query", ["", "?from=0.5&to=4.1", "?from=4.6&to=5.1", "?from=4.79&to=4.83", "?from=1.85&to=1.9"]
)
@pytest.mark.parametrize("width", [280, 1366])
def test_no_peak_hides_at_any_zoom(
    walk: Recording, open_page: OpenPage, query: str, width: int
) -> None:
    page = open_page(url_of(walk, query), width)
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
    box = page.locator("#summary")  # not the peak of the stance beside it, free of noise
    largest = np.nanargmax(np.where(inside, grf_n, np.nan))  # its own time, whatever the zoom
    expect(box).to_contain_text(
        f"largest frame {grf_n[largest]:.1f} N at {since_s[largest]:.2f} s,"
    )
    expect(box).to_have_attribute("title", re.compile("noise included"))
    assert summary(page, "grf-min") == pytest.approx(np.nanmin(grf_n[inside]), abs=1e-5)


def test_what_is_shown_is_in_the_link_and_comes_back_with_it(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(walk))
    all_s = seen(page)
    box = box_of(page.locator("#plots"))
    page.mouse.move(box["x"] + 300, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 600, box["y"] + 100, steps=4)
    page.mouse.up()
    expect(page).to_have_url(re.compile(r"\?from=[0-9.]+&to=[0-9.]+&at=[0-9.]+$"))
    chosen = seen(page)
    assert 0 < chosen[0] < chosen[1] < all_s[1]
    again = open_page(page.url)
    assert seen(again) == pytest.approx(chosen, abs=1e-3)
    again.mouse.move(box["x"] + 400, box["y"] + 100)
    again.mouse.wheel(0, 300)
    until(lambda: again.evaluate("scrollY") > 100)  # the page, and nothing else
    assert seen(again) == pytest.approx(chosen, abs=1e-3)
    again.mouse.wheel(0, -600)
    until(lambda: again.evaluate("scrollY") == 0)
    again.keyboard.down("Control")
    again.mouse.wheel(0, -300)
    again.keyboard.up("Control")
    expect(again.locator("#plots")).not_to_have_attribute("data-from", f"{chosen[0]:.4f}")
    closer = seen(again)
    assert chosen[0] < closer[0] < closer[1] < chosen[1]
    again.mouse.dblclick(box["x"] + 400, box["y"] + 100)
    expect(again).not_to_have_url(re.compile("from="))
    assert seen(again) == all_s


def test_a_peak_is_written_once_and_the_cursor_leaves_it_legible(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(
        url_of(walk),
        first="""const { fillText } = CanvasRenderingContext2D.prototype;
        window.written = [];
        CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
          window.written.push([this.canvas.id, text, ...place]);
          fillText.call(this, text, ...place);
        };""",
    )
    settled(page)
    page.locator("#stances-rows tr").nth(1).click()  # the cursor is at its peak
    expect(page.locator("#plots")).to_have_attribute("data-whole", "false")
    settled(page)
    peak = f"{walk.running.http.get(f'{walk.url}/stances').json()[1]['peak_grf_n']:.1f}"
    ink = page.evaluate(
        """(peak) => {
          const [, , x, y] = window.written.findLast(([, text]) => text === peak);
          const over = document.getElementById("cursor-canvas");
          const ratio = over.width / over.clientWidth;
          const { data, width } = over.getContext("2d")
            .getImageData((x - 20) * ratio, (y - 40) * ratio, 40 * ratio, 92 * ratio);
          const inkOf = (fromPx, toPx) => data // from the value's foot
            .slice(...[fromPx, toPx].map((px) => 4 * width * Math.round((px + 40) * ratio)))
            .some((value) => value > 0);
          return { above: inkOf(-40, -28), value: inkOf(-14, 0), below: inkOf(40, 52) };
        }""",
        peak,
    )
    assert ink == {"above": True, "value": False, "below": True}
    assert "cursor-canvas" not in page.evaluate("window.written.map(([canvas]) => canvas)")


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
    expect(page).not_to_have_url(re.compile("from="))
    assert seen(page) == all_s


def test_whole_stances_lie_one_upon_another_and_a_click_on_one_goes_there(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(walk))
    canvas = page.locator("#overlay-canvas")
    canvas.scroll_into_view_if_needed()
    says = page.locator("#overlay-summary")
    expect(says).to_contain_text("6 whole stances")
    expect(says).to_contain_text("1 incomplete stance left out")
    box = box_of(canvas)
    at = page.locator("#overlay-at")
    expect(at).to_have_text(
        re.compile(r"Mean has its maximum at \d+ %: [0-9.]+ N \(SD [0-9.]+ N\)")
    )
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
    expect(legend).to_contain_text("stance 7 is incomplete")


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
    expect(legend).to_contain_text("end: stance 2")
    by_time = canvas.screenshot()
    page.get_by_role("button", name="stance", exact=True).click()
    expect(legend).to_contain_text("first stance to last stance")
    assert canvas.screenshot() != by_time


def test_a_marker_is_set_at_the_cursor_and_what_is_in_view_can_be_downloaded(
    walk: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(walk, "?from=1&to=1.2"))
    settled(page)
    page.keyboard.press("ArrowRight")
    readout = page.locator("#readout")
    expect(readout).to_have_attribute("data-time-s", re.compile("."))
    at_s = readout.get_attribute("data-time-s")
    page.fill("#new-marker-label", "here")
    page.press("#new-marker-label", "Enter")
    expect(page.locator("#notices")).to_contain_text("Marker “here” set")
    events = walk.running.http.get(f"{walk.url}/markers").json()["items"]
    t_ns = next(event["t_ns"] for event in events if event["label"] == "here")
    since_s = (t_ns - int(walk.column("t_ns")[0])) * 1e-9
    assert since_s == pytest.approx(float(at_s or "nan"), abs=1e-5)
    with page.expect_download() as download:
        page.click("#download-csv")
    lines = download.value.path().read_text("utf-8").splitlines()
    assert len([line for line in lines if not line.startswith("#")]) == 101
    page.click("#downloads-more summary")
    expect(page.locator("#download-xdf")).to_be_visible()
    expect(page.locator("#download-take")).to_be_hidden()  # it is of none
    offered = page.locator("#download-list [data-format]")
    names = offered.evaluate_all("items => items.map((item) => item.dataset.format)")
    assert set(names) == set(FORMATS) - {"parquet", "arrow", "csv"}
    with page.expect_download() as further:
        page.click("#download-xdf")
    assert further.value.suggested_filename == f"walk_{walk.id}_1.000s-to-1.200s.xdf"
    assert further.value.path().read_bytes().startswith(b"XDF:")
    with page.expect_download() as picture:
        page.click("#picture")
    assert picture.value.path().read_bytes().startswith(b"\x89PNG")


def test_a_gap_is_empty_in_lines_and_bands_at_any_zoom(
    server: Running, open_page: OpenPage
) -> None:
    node = FakeNode(server, "late")
    node.connect()
    node.tared()
    session = node.record(name="late")
    node.send(512, [20.0, 60.0], alive=True)
    node.next_t_mono_ns += 1_000_000_000  # no frame is sampled, none is lost
    node.send(512, [20.0, 60.0], alive=True)
    node.finish(session)
    node.close()
    since_s, _ = grf(session)
    gap = int(np.argmax(np.diff(since_s)))
    begin_s, end_s = since_s[gap], since_s[gap + 1]
    assert end_s - begin_s == pytest.approx(1.002)
    for query in ("", f"?from={begin_s - 0.02}&to={end_s + 0.02}"):
        for width in (1366, 390, 280):  # frame by frame, and merged
            page = open_page(url_of(session, query), width)
            from_s, to_s = seen(page)
            left = left_px(page)
            full = float(page.locator("#plots").evaluate("(plots) => plots.clientWidth"))

            def share(time_s: float, left: float = left, full: float = full) -> float:
                return (left + (time_s - from_s) / (to_s - from_s) * (full - left - 12)) / full  # noqa: B023

            canvas, margin_s = "#plots-canvas", 0.05 * (end_s - begin_s)
            assert blue_px(page, canvas, share(begin_s + margin_s), share(end_s - margin_s)) == 0
            assert blue_px(page, canvas, share(from_s), share(begin_s)) > 20
            assert blue_px(page, canvas, share(end_s), share(to_s)) > 20


def test_an_interval_that_reaches_beyond_the_axis_says_so(
    walk: Recording, open_page: OpenPage
) -> None:
    def widen(route: Route) -> None:
        answer = route.fetch()
        body = answer.json()
        columns = body["columns"]
        for end, of, by_n in (("low_n_min", "min", -16.0), ("high_n_max", "max", 16.0)):
            values = columns[f"grf_n_{of}"]
            columns[f"grf_{end}"] = [None if one is None else one + by_n for one in values]
        route.fulfill(response=answer, json=body)

    query = "?from=0.05&to=0.3"  # unloaded
    page = open_page(url_of(walk, query))
    expect(settled(page)).to_have_attribute("data-clipped", "")
    sign = page.locator('#legend [data-kind="clipped"]')
    expect(sign).to_have_count(0)
    answers = {"**/timeseries?**": widen}
    page = open_page(url_of(walk, query), answers=answers, service_workers="block")
    expect(settled(page)).to_have_attribute("data-clipped", "grf")
    expect(page.locator('#legend [data-kind="clipped"]')).to_have_text(
        "interval reaches beyond the axis"
    )
    assert complaints_at(page) == []

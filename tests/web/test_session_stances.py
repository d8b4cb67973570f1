"""Stances of a session's page: found, gone to, and read, on a phone as on a desk."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.builders.arrays import PERIOD_NS
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running
from tests.waiting import until
from tests.web.pages import OpenPage, box_of, complaints, width_of
from tests.web.session_page import settled

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


STANCES = 12
PHONE: dict[str, Any] = {"width": 390, "height": 844, "has_touch": True, "is_mobile": True}
_IN_SIGHT = """([selector, downTo]) => {
  const box = document.querySelector(selector).getBoundingClientRect();
  return box.top >= 0 && box.top + downTo <= innerHeight;
}"""
_KEYS_SHOWN = "[...document.querySelectorAll('kbd')].filter((key) => key.checkVisibility()).length"
FIGURES = (
    ("peak", "peak_grf_n", 1, 1, "N"),
    ("duration", "duration_s", 1e3, 0, "ms"),
    ("impulse", "impulse_n_s", 1, 2, "N s"),
    ("travel", "cop_x_range_m", 1e3, 1, "mm"),
)
SIGMAS = {
    "peak_grf_n": "peak_sigma_n",
    "duration_s": "duration_sigma_s",
    "impulse_n_s": "impulse_sigma_n_s",
    "cop_x_range_m": "cop_x_range_sigma_m",
}
FORCE_PX = 200  # from the upper edge of the plots to the foot of the first


@pytest.fixture(scope="module")
def hops(server: Running) -> Recording:
    """Twelve stances, each harder than the one before."""
    node = FakeNode(server, "hopper")
    node.connect()
    node.tared()
    session = node.record(name="hops")
    for i in range(STANCES):
        node.send(100, [0.0, 0.0], alive=True)
        node.send(100, [10.0 + i, 30.0 + 2 * i], alive=True)
    node.deliver(100, [0.0, 0.0], alive=True)
    node.finish(session)
    node.close()
    return session


@pytest.fixture(scope="module")
def stances(hops: Recording) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = hops.running.http.get(f"{hops.url}/stances").json()
    assert len(found) == STANCES
    return found


def opened(open_page: OpenPage, session: Recording, query: str = "", **options: Any) -> Page:
    page = open_page(f"{session.running.url}/sessions/{session.id}{query}", **options)
    expect(page.locator("#stance-line")).to_be_visible()
    settled(page)
    return page


def says(page: Page, stance: dict[str, Any]) -> None:
    """The headline tells of this one, with its intervals, and so does the table."""
    says = f"Stance {stance['number']} of {STANCES}"
    expect(page.locator("#stance-text")).to_contain_text(says)
    for figure, stem, factor, decimals, unit in FIGURES:
        value = f"{factor * stance[stem]:.{decimals}f}"
        half = f"{1.96 * factor * stance[SIGMAS[stem]]:.{decimals}f}"
        shown = page.locator(f"#stance-figures [data-figure={figure}] dd")
        expect(shown).to_have_text(f"{value} ± {half} {unit}")
    row = page.locator("#stances-rows [aria-current]")
    expect(row).to_have_attribute("data-stance", str(stance["number"]))


def in_view(page: Page, stance: dict[str, Any], begin_ns: int) -> None:
    """It, and little else, is plotted."""
    plots = settled(page)
    begin_s, end_s = (
        float(plots.get_attribute(f"data-{name}") or "nan") for name in ("from", "to")
    )
    assert begin_s < (stance["begin_t_ns"] - begin_ns) * 1e-9
    assert end_s > (stance["end_t_ns"] - begin_ns) * 1e-9
    assert end_s - begin_s < 2 * stance["duration_s"]


def middle_of(
    page: Page, stance: dict[str, Any], hops: Recording, left: float = 40
) -> tuple[float, float]:
    """Where it is in the plots, which show everything; `left`: axis, of a narrow screen."""
    page.evaluate("scrollTo(0, 0)")  # the buttons that zoom are below the plots
    box = settled(page).bounding_box()
    duration_s = float(page.locator("#plots").get_attribute("data-to") or "nan")
    right = 12  # air
    begin_ns = int(hops.column("t_ns")[0])
    middle_s = (0.5 * (stance["begin_t_ns"] + stance["end_t_ns"]) - begin_ns) * 1e-9
    at = left + (box["width"] - left - right) * middle_s / duration_s
    return box["x"] + at, box["y"] + 100


def test_a_laptop_shows_four_rows_and_a_stance_is_gone_to_from_its_row_and_by_keys(
    hops: Recording, stances: list[dict[str, Any]], open_page: OpenPage
) -> None:
    page = opened(open_page, hops)
    begin_ns = int(hops.column("t_ns")[0])
    rows = page.locator("#stances-rows tr")
    expect(rows).to_have_count(STANCES)
    box, fourth = box_of(page.locator("#stances-scroll")), box_of(rows.nth(3))
    assert fourth["y"] + fourth["height"] <= box["y"] + box["height"]
    for part in ("#grf", "#contact", "#foot", "#cop"):
        expect(page.locator(part)).to_be_in_viewport(ratio=1)
    expect(rows.nth(11)).to_contain_text(f"{stances[11]['peak_grf_n']:.1f} ±")

    def shows(number: int) -> None:
        says(page, stances[number - 1])
        in_view(page, stances[number - 1], begin_ns)

    rows.nth(1).click()
    shows(2)
    page.keyboard.press("]")
    shows(3)
    page.keyboard.press("[")
    page.keyboard.press("[")
    shows(1)
    page.keyboard.press("[")  # there is none before it
    shows(1)


def test_on_a_phone_a_stance_is_three_taps_away_and_where_the_plots_are_touched_it_is_said(
    hops: Recording, stances: list[dict[str, Any]], open_page: OpenPage
) -> None:
    page = opened(open_page, hops, **PHONE)
    which = page.locator("#stance-which")
    expect(which).to_have_text(f"{STANCES} stances, median of {STANCES} whole")
    assert page.evaluate(_IN_SIGHT, ["#stance-line", 44])  # without scrolling
    for stance in stances[:3]:
        page.tap("#stance-next")
        says(page, stance)
    assert page.evaluate(_IN_SIGHT, ["#plots", FORCE_PX])
    assert page.evaluate("scrollY") == 0
    for button in ("#stance-before", "#stance-next"):
        box = box_of(page.locator(button))
        assert min(box["width"], box["height"]) >= 44
    assert complaints(page) == []

    page.tap("#zoom-all")
    page.touchscreen.tap(*middle_of(page, stances[6], hops))
    says(page, stances[6])
    # Its force is in the bar at the foot of the screen: that beside the foot is out of sight.
    expect(page.locator("#replay-force")).to_be_in_viewport(ratio=1)
    expect(page.locator("#replay-force")).to_have_text(re.compile(r"^, [0-9.]+ ± [0-9.]+ N$"))
    force_n = float((page.locator("#grf").text_content() or "").strip())
    assert f" {force_n:.1f} ±" in (page.locator("#replay-force").text_content() or "")
    expect(page.locator("#replay-frame")).to_be_hidden()
    assert width_of(page) == PHONE["width"]
    page.tap("#stance-next")  # it goes on from there
    says(page, stances[7])


def test_a_row_that_is_tapped_brings_its_plot_into_view_and_the_overlay_follows_the_cursor(
    hops: Recording, stances: list[dict[str, Any]], open_page: OpenPage
) -> None:
    page = opened(open_page, hops, **PHONE)
    page.locator("#stances-rows tr").nth(2).tap()
    says(page, stances[2])
    in_view(page, stances[2], int(hops.column("t_ns")[0]))
    assert page.evaluate(_IN_SIGHT, ["#stance-line", 44])
    assert page.evaluate(_IN_SIGHT, ["#plots", FORCE_PX])
    page.locator("#overlay-card").scroll_into_view_if_needed()
    legend = page.locator("#overlay-legend")
    expect(legend).to_contain_text("mean")
    page.locator("#stances-rows tr").nth(4).tap()
    expect(legend).to_contain_text("stance 5,")
    page.tap("#zoom-all")
    page.touchscreen.tap(*middle_of(page, stances[6], hops))
    expect(legend).to_contain_text("stance 7,")


def test_a_finger_that_scrolls_the_page_leaves_the_cursor_where_it_was(
    hops: Recording, stances: list[dict[str, Any]], open_page: OpenPage
) -> None:
    page = opened(open_page, hops, **PHONE)
    for _ in range(3):
        page.tap("#stance-next")
    says(page, stances[2])
    page.tap("#zoom-all")
    x, y = middle_of(page, stances[8], hops)
    cursor_s = page.locator("#readout").get_attribute("data-time-s") or ""
    finger = page.context.new_cdp_session(page)

    def touch(kind: str, *points: dict[str, float]) -> None:
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

    touch("touchStart", {"x": x, "y": y})
    for up in range(15, 240, 15):
        touch("touchMove", {"x": x, "y": y - up})
    touch("touchEnd")
    until(lambda: page.evaluate("scrollY") > 100)
    expect(page.locator("#stance-which")).to_contain_text("median")
    expect(page.locator("#readout")).to_have_attribute("data-time-s", cursor_s)


def test_of_a_stance_that_was_not_seen_whole_the_line_says_so(
    server: Running, open_page: OpenPage
) -> None:
    node = FakeNode(server, "late")
    node.connect()
    node.tared()
    session = node.record(name="begun too late")
    node.send(60, [12.0, 20.0], alive=True)
    node.send(100, [0.0, 0.0], alive=True)
    node.send(100, [12.0, 20.0], alive=True)
    node.deliver(100, [0.0, 0.0], alive=True)
    node.finish(session)
    node.close()
    page = opened(open_page, session, **PHONE)
    page.tap("#stance-next")
    expect(page.locator("#stance-text")).to_contain_text("start not recorded")
    row = page.locator("#stances-rows tr").first
    expect(row.get_by_text("⚠ cut at start")).to_be_visible()
    first = session.running.http.get(f"{session.url}/stances").json()[0]
    at_least = re.compile(rf"^≥\s{1e3 * first['duration_s']:.0f}\s")  # it began before
    expect(row.get_by_role("cell").nth(2)).to_have_text(at_least)
    expect(page.locator("#stance-figures [data-figure=duration] dd")).to_have_text(at_least)
    for figure in ("peak", "impulse", "travel"):
        expect(page.locator(f"#stance-figures [data-figure={figure}] dd")).to_contain_text("≥")
    expect(row.locator(".why")).to_have_attribute("title", "start not recorded")
    page.tap("#stance-next")
    expect(page.locator("#stance-which")).to_have_text("Stance 2 of 2")
    expect(page.locator("#stance-flags")).to_be_empty()
    expect(page.locator("#stance-figures")).not_to_contain_text("≥")
    assert width_of(page) == PHONE["width"]
    assert complaints(page) == []


def record_with_gaps(server: Running, name: str, slots: list[int]) -> Recording:
    """Record a stance of 0.4 s for each number of slots that are not sampled in its middle."""
    node = FakeNode(server, name.replace(" ", "-"))
    node.connect()
    node.tared()
    session = node.record(name=name)
    for count in slots:
        node.send(100, [0.0, 0.0], alive=True)
        node.send(100, [12.0, 24.0], alive=True)
        node.next_t_mono_ns += count * PERIOD_NS
        node.send(100, [12.0, 20.0], alive=True)
    node.deliver(100, [0.0, 0.0], alive=True)
    node.finish(session)
    node.close()
    return session


@pytest.mark.parametrize("size", [{"width": 1280, "height": 800}, PHONE], ids=["laptop", "phone"])
def test_a_gap_in_a_stance_is_bridged_and_shown(
    server: Running, open_page: OpenPage, size: dict[str, Any]
) -> None:
    session = record_with_gaps(server, f"gap {size['width']}", [0, 0, 30, 0])
    page = opened(open_page, session, **size)
    expect(page.locator("#stance-which")).to_have_text("4 stances, median of 4 whole")
    expect(page.locator("#stance-flags")).to_be_empty()
    row = page.locator("#stances-rows tr").nth(2)
    row.locator("button").click()
    expect(page.locator("#stance-flags")).to_have_text(
        "62 ms without frames, which may hide the peak"
    )
    expect(row.get_by_text("⚠ gaps")).to_be_visible()
    figures = page.locator("#stance-figures")
    expect(figures.locator("[data-figure=impulse] dd")).to_have_text(re.compile(r"^[0-9.]+\s±"))
    expect(figures.locator("[data-figure=peak] dd")).to_have_text(re.compile(r"^≥\s36\.0\sN"))
    page.locator("#overlay-card").scroll_into_view_if_needed()
    expect(page.locator("#overlay-legend")).to_contain_text("stance 3, frame by frame")
    overlay = session.running.http.get(f"{session.url}/stances/overlay").json()
    counts = overlay["spread"]["grf_n"]["count"]
    assert (counts[50], counts[20], counts[80]) == (3, 4, 4)
    assert width_of(page) == size["width"]
    assert complaints(page) == []


@pytest.mark.parametrize("size", [{"width": 1280, "height": 800}, PHONE], ids=["laptop", "phone"])
def test_without_a_majority_of_whole_stances_the_headline_says_why_there_is_no_median(
    server: Running, open_page: OpenPage, size: dict[str, Any]
) -> None:
    session = record_with_gaps(server, f"torn {size['width']}", [0, 120, 120])
    page = opened(open_page, session, **size)
    expect(page.locator("#stance-which")).to_have_text("5 stances")
    expect(page.locator("#stance-flags")).to_have_text("no medians: only 1 whole; 4 cut")
    for figure in ("peak", "duration", "impulse", "travel"):
        shown = page.locator(f"#stance-figures [data-figure={figure}] dd")
        expect(shown).to_have_text(re.compile("^\u2013"))
    assert width_of(page) == size["width"]
    assert complaints(page) == []


def test_a_phone_is_not_told_of_keys(hops: Recording, open_page: OpenPage) -> None:
    page = opened(open_page, hops, **PHONE)
    hint = page.locator("#readout-hint")
    assert "Read values: touch" in hint.inner_text()
    assert "wheel" not in hint.inner_text()
    for path in (f"/sessions/{hops.id}", "/nodes", "/"):
        page.goto(f"{hops.running.url}{path}")
        page.tap("#help")
        expect(page.locator("#help-dialog")).to_be_visible()
        assert page.evaluate(_KEYS_SHOWN) == 0, path
        assert complaints(page) == []
    desk = opened(open_page, hops)
    assert "wheel" in desk.locator("#readout-hint").inner_text()
    desk.keyboard.press("?")
    assert desk.evaluate(_KEYS_SHOWN) > 6


def test_axe_has_nothing_to_complain_of_in_the_dark_or_the_sun_with_a_stance_and_with_help(
    hops: Recording, stances: list[dict[str, Any]], open_page: OpenPage
) -> None:
    page = opened(open_page, hops, color_scheme="dark")
    page.keyboard.press("]")
    says(page, stances[0])
    for scheme in ("dark", "sunlight"):
        if scheme == "sunlight":  # whatever the machine prefers
            page.click("#sun")
        assert complaints(page) == [], scheme
        page.keyboard.press("?")
        expect(page.locator("#help-dialog")).to_be_visible()
        assert complaints(page) == [], scheme
        page.keyboard.press("Escape")
        expect(page.locator("#help-dialog")).to_be_hidden()


def test_a_selected_stance_stays_selected_until_all_or_escape_is_pressed(
    hops: Recording, stances: list[dict[str, Any]], open_page: OpenPage
) -> None:
    page = opened(open_page, hops)
    medians = f"{STANCES} stances, median of {STANCES} whole"
    which = page.locator("#stance-which")
    box = box_of(page.locator("#plots"))

    def point(share: float) -> None:
        """Point there; wait until the values are read."""
        read = page.locator("#readout").get_attribute("data-time-s") or ""
        page.mouse.move(box["x"] + share * box["width"], box["y"] + 100)
        expect(page.locator("#readout")).not_to_have_attribute("data-time-s", read)

    point(0.5)
    expect(which).to_have_text(medians)  # pointing reads
    deselections: tuple[Callable[[], None], ...] = (
        lambda: page.keyboard.press("Escape"),
        lambda: page.click("#zoom-all"),
    )
    for deselect in deselections:
        page.locator("#stances-rows tr").nth(2).click()
        says(page, stances[2])
        for share in (0.2, 0.95):  # within it, and in the pause behind it
            point(share)
            says(page, stances[2])
        expect(page).to_have_url(re.compile("&stance=3$"))
        says(opened(open_page, hops, query="?stance=3"), stances[2])
        deselect()
        expect(which).to_have_text(medians)
        expect(page).not_to_have_url(re.compile("stance="))
    page.mouse.click(*middle_of(page, stances[6], hops, left=56))
    says(page, stances[6])


def test_a_link_that_was_copied_leads_to_the_same_stance_and_cursor(
    hops: Recording, stances: list[dict[str, Any]], open_page: OpenPage
) -> None:
    page = opened(open_page, hops)
    page.context.grant_permissions(["clipboard-read"])
    page.locator("#stances-rows tr").nth(2).click()
    says(page, stances[2])
    page.focus("#plots")  # in the table the key scrolls
    page.keyboard.press("ArrowRight")
    readout = page.locator("#readout")
    peak_s = (stances[2]["peak_t_ns"] - int(hops.column("t_ns")[0])) * 1e-9
    until(lambda: float(readout.get_attribute("data-time-s") or 0) == pytest.approx(peak_s + 0.002))
    page.click("#copy-link")
    expect(page.locator("#notices")).to_contain_text("Link copied")
    there = open_page(page.evaluate("navigator.clipboard.readText()"))
    says(there, stances[2])
    at_s = readout.get_attribute("data-time-s") or ""
    expect(there.locator("#readout")).to_have_attribute("data-time-s", at_s)
    for name in ("data-from", "data-to"):
        expect(settled(there)).to_have_attribute(name, settled(page).get_attribute(name) or "")


def test_playback_of_a_selected_stance_ends_with_the_view_and_a_link_names_it_only_in_view(
    hops: Recording, stances: list[dict[str, Any]], open_page: OpenPage
) -> None:
    page = opened(open_page, hops)
    page.locator("#stances-rows tr").nth(2).click()
    says(page, stances[2])
    plots, readout, play = (page.locator(of) for of in ("#plots", "#readout", "#play"))
    shown = [float(settled(page).get_attribute(f"data-{of}") or "nan") for of in ("from", "to")]
    page.evaluate("""() => {
      window.read = [];
      const readout = document.getElementById("readout");
      new MutationObserver(() => window.read.push(Number(readout.dataset.timeS)))
        .observe(readout, { attributeFilter: ["data-time-s"] });
    }""")
    for _ in range(2):  # the second begins at the start of the view
        page.click("#play")
        expect(play).to_have_attribute("data-going", "false")
        until(lambda: float(readout.get_attribute("data-time-s") or 0) > shown[1] - 0.005)
        expect(plots).to_have_attribute("data-from", f"{shown[0]:.4f}")
    assert min(page.evaluate("window.read")) < shown[0] + 0.1
    expect(page).to_have_url(re.compile("&stance=3$"))
    for _ in range(4):
        page.click("#later")
    expect(page).not_to_have_url(re.compile("stance="))
    says(page, stances[2])


def test_the_chosen_stance_is_exported_from_its_first_frame_to_its_last(
    hops: Recording, stances: list[dict[str, Any]], open_page: OpenPage
) -> None:
    page = opened(open_page, hops)
    choice = page.locator("#download-range")
    expect(choice.locator("option")).to_have_text(["whole session"])
    page.locator("#stances-rows tr").nth(2).click()
    says(page, stances[2])
    page.click("#export")
    expect(choice).to_be_focused()
    expect(choice).to_have_value("stance")
    with page.expect_download() as download:
        page.click("#download-csv")
    lines = download.value.path().read_text("utf-8").splitlines()
    rows = [line for line in lines if not line.startswith("#")][1:]
    assert len(rows) == stances[2]["frames"]
    begin_s = (stances[2]["begin_t_ns"] - int(hops.column("t_ns")[0])) * 1e-9
    assert download.value.suggested_filename.startswith(f"hops_{hops.id}_{begin_s:.3f}s-to-")
    choice.select_option("view")
    expect(page.locator("#download-csv")).to_have_attribute("href", re.compile("start_s="))

"""The live view shows the foot: colours, range, trail, traces, and how it fits on screens."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Page, expect

from devices.frames import ArrayInfo, TileInfo
from service.api.app import find_page_folder
from tests.builders.arrays import make_array, make_tile
from tests.service.fake_node import FakeNode, Play
from tests.waiting import until
from tests.web.pages import (
    LIVE,
    PHONE,
    OpenPage,
    at_sizes,
    blue_px,
    box_of,
    complaints,
    live,
    width_of,
)
from tests.web.scripted import Scripted
from tests.web.session_page import settled

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


OF_THEIR_FORCE = """async () => {
  const { shadesOf, shadeOf } = await import("/static/common/heat.js");
  const shades = shadesOf(document.querySelector("#foot"));
  const most = Number.parseFloat(document.querySelector("#foot .heat-legend text").textContent);
  const tiles = [...document.querySelectorAll("#bars .tile")];
  const symbols = [...document.querySelectorAll("#foot .tile-symbol .dome")];
  const near = (fill, share) =>
    [-1, 0, 1].some((by) => shadeOf(shades, share + by / 32).fill === fill);
  return symbols.length === 2 && symbols.every((dome, i) =>
    near(dome.getAttribute("fill"), Number(tiles[i].dataset.value) / most));
}"""
"""Is each tile of the picture of the colour of its force? One step of the colours is let pass."""

BARS_OF_THEIR_FORCE = """() => {
  const canvas = document.querySelector("#tracks");
  const copy = new OffscreenCanvas(canvas.width, canvas.height)
    .getContext("2d", { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0);
  const origin = canvas.getBoundingClientRect();
  return [...document.querySelectorAll("#bars .tile")].every((tile) => {
    const track = tile.querySelector(".track");
    const box = track.getBoundingClientRect();
    const full = Number.parseFloat(tile.querySelector(".scale").textContent.split("-")[1]);
    const left = Math.round(box.left - origin.left + 0.1 * box.width);
    const [top, height] = [Math.round(box.top - origin.top), Math.round(box.height)];
    const column = copy.getImageData(left, top, 1, height).data;
    let blue = 0;
    for (let i = 0; i < column.length; i += 4) blue += column[i + 2] - column[i] > 60;
    const longPx = Number(tile.dataset.value) / full / 1.1 * track.clientHeight - 4;
    return longPx > 2 && Math.abs(blue - longPx) < 3;
  });
}"""
"""Is each bar as long as its value says? Two pixels at each end are under lines."""

HAS_THE_KPA_OF_ITS_BAR = """() => {
  const { unit, value } = document.querySelector("#bars .tile").dataset;
  const shown = document.querySelector("#foot .name").textContent;
  return unit === "kPa" && value !== "" && shown === Number(value).toFixed(1);
}"""
"""Has the first tile of the foot the number of its bar, in kPa?"""


class Arranged(FakeNode):
    """A node with tiles in places of the test's own."""

    placed: list[TileInfo]

    @property
    def info(self) -> ArrayInfo:
        facts = {"node": self.name, "stream_id": self.stream_id}
        return make_array(self.placed, **facts, utc_offset_ns=self.utc_offset_ns)


def arranged(scripted: Scripted, name: str, tiles: list[TileInfo]) -> FakeNode:
    """A node with these tiles that is ready to play."""
    node = Arranged(scripted.running, name, tiles=len(tiles))
    node.placed = tiles
    node.connect()
    node.tared()
    return node


def top_of(page: Page, selector: str) -> float:
    return box_of(page.locator(selector))["y"]


def bottom_of(page: Page, selector: str) -> float:
    box = box_of(page.locator(selector))
    return box["y"] + box["height"]


def test_bars_and_tiles_show_their_force_in_both_ranges_and_on_any_screen(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0):
        page = live(open_page(scripted.url))
        top = page.locator("#foot .heat-legend text").first
        scale = page.locator("#bars .scale").first
        expect(page.locator("#range")).to_have_text("Range: fixed")
        before, fixed = top.text_content() or "", scale.inner_text()
        for of_their_force in (OF_THEIR_FORCE, BARS_OF_THEIR_FORCE):
            page.wait_for_function(of_their_force)
        page.click("#range")
        expect(page.locator("#range")).to_have_text("Range: auto")
        expect(top).not_to_have_text(before)
        expect(scale).not_to_have_text(fixed)
        for of_their_force in (OF_THEIR_FORCE, BARS_OF_THEIR_FORCE):
            page.wait_for_function(of_their_force)
        for size in at_sizes(page, PHONE, *((width, 800) for width in (320, 600, 1000, 2560))):
            page.wait_for_function(BARS_OF_THEIR_FORCE)
            assert width_of(page) == size[0]
        page.reload()
        expect(page.locator("#range")).to_have_text("Range: auto")


def test_a_grid_is_a_heat_map_with_readable_numbers_on_a_phone(
    scripted: Scripted, open_page: OpenPage
) -> None:
    tiles = [
        make_tile(i, x_m=0.014 * (i // 8), y_m=0.014 * (i % 8), z_m=0.0, mux=0x70 + i // 8)
        for i in range(64)
    ]

    node = arranged(scripted, "grid", tiles)
    with Play(node, 12.0):
        page = open_page(scripted.url, 390, 844)
        page.select_option("#node-select", "grid")
        expect(page.locator(LIVE)).to_have_count(1)
        expect(page.locator("#foot rect.dome")).to_have_count(64)
        expect(page.locator("#range")).to_have_text("Range: auto")
        number = page.locator("#foot .name").first
        expect(number).to_have_text("12")
        on_top = """() => {
          const all = [...document.querySelectorAll("#foot *")];
          const last = (of) => all.findLastIndex((one) => one.matches(of));
          return all.findIndex((one) => one.matches(".name")) > last("[class^=cop], .dome");
        }"""
        assert page.evaluate(on_top)  # the COP and its trail cover no number
        page.click("#unit-kpa")
        page.wait_for_function(HAS_THE_KPA_OF_ITS_BAR)
        expect(page.locator("#foot .heat-legend")).to_contain_text("kPa")
        page.click("#unit-n")
        cell = box_of(page.locator("#foot rect.dome").first)
        assert cell["width"] >= 26
        assert bottom_of(page, "#foot") < top_of(page, "#actions")
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        assert complaints(page) == []
    node.close()


def test_a_row_of_tiles_draws_the_cop_on_the_row_and_gives_no_number_across_it(
    scripted: Scripted, open_page: OpenPage
) -> None:
    rows = {  # each with a reference tile beside it: drawn from above
        r"COP x .+ ± .+ mm \(95\s%\), y not measured": [(0.0, 0.012), (0.014, 0.012), (0.0, 0.04)],
        r"COP y .+ ± .+ mm \(95\s%\), x not measured": [(0.02, -0.01), (0.02, 0.01), (0.05, 0.0)],
    }
    page = open_page(scripted.url)
    for text, places_m in rows.items():
        tiles = [
            make_tile(i, x_m=x_m, y_m=y_m, reference=i == 2)
            for i, (x_m, y_m) in enumerate(places_m)
        ]
        node = arranged(scripted, f"row-{text[4]}", tiles)
        with Play(node, 15.0):
            page.goto(scripted.url)
            page.select_option("#node-select", node.name)
            expect(page.locator("#cop")).to_have_text(re.compile(f"^{text}$"))
            expect(page.locator("#foot .cop-symbol")).to_be_visible()
            page.goto(f"{scripted.url}/nodes")
            expect(page.locator(f'.node[data-node="{node.name}"][data-live="true"]')).to_have_count(
                1
            )
        node.close()


def test_the_first_screen_of_a_phone_has_what_matters(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0):
        page = live(open_page(scripted.url, *PHONE))
        trouble = [f"trouble {i} that is long enough for two lines of a phone" for i in range(9)]
        scripted.tell(*trouble)
        expect(page.locator("#notes-more")).to_have_text("8 more")
        expect(page.locator("#tared")).to_have_text(re.compile("^Tared .+ ago$"))
        expect(page.locator("#fields")).to_have_text("Names …")
        for _, height in at_sizes(page, (390, 740), PHONE):
            bar = box_of(page.locator("#actions"))
            assert bar["height"] < 110  # a line of what is recorded, and the buttons
            assert bar["y"] + bar["height"] <= height
            for part in ("#notes-box", "#grf", "#tared", "#trace", "#foot", "#record"):
                assert bottom_of(page, part) <= height, part
        assert bottom_of(page, "#bars") <= bar["y"]  # on the higher one
        rows = {
            round(top_of(page, f"#{name}"))
            for name in ("tare", "record", "undo", "marker", "fields")
        }
        assert len(rows) == 1
        expect(page.locator("#session-name")).to_be_hidden()
        page.click("#fields")
        page.fill("#session-name", "mud")
        page.click("#record")
        expect(page.locator("#recordings")).to_contain_text("mud")
        page.click("#notes-more")
        expect(page.locator("#notes li").nth(8)).to_be_visible()
        page.click("#notes-more")
        expect(page.locator("#notes li").nth(8)).to_be_hidden()


def test_eight_tiles_are_on_one_screen_of_a_laptop(scripted: Scripted, open_page: OpenPage) -> None:
    scripted.node.close()
    node = FakeNode(scripted.running, "eight", tiles=8)
    node.connect()
    node.tared()
    with Play(node, 12.0):
        page = open_page(scripted.url, 1280, 800)
        page.select_option("#node-select", "eight")
        expect(page.locator(LIVE)).to_have_count(1)
        expect(page.locator("#bars .tile")).to_have_count(8)
        for part in (
            "#grf-card",
            "#foot-card",
            "#bars-card",
            "#trace-card",
            "#actions",
            "#calibration",
        ):
            assert bottom_of(page, part) <= 800, part
        assert bottom_of(page, "#calibration") <= 800  # without unfolding anything
        cut = page.evaluate(
            """() => [...document.querySelectorAll("#live .card, #bars .tile")]
              .filter((one) => one.scrollHeight > one.clientHeight + 1)
              .map((one) => one.id || one.className)"""
        )
        assert cut == []
    node.close()


def test_tiles_are_shown_as_traces_whose_range_covers_what_is_in_view_and_this_is_remembered(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0) as play:
        page = live(open_page(scripted.url))
        page.click("#as-traces")
        expect(page.locator("#bars")).to_be_hidden()
        until(lambda: blue_px(page, "#tile-traces", 0.5, 1.0) > 50)
        assert complaints(page) == []
        page.click("#range")
        expect(page.locator("#range")).to_have_text("Range: auto")
        top = page.locator("#foot .heat-legend text").first
        expect(top).to_have_text("15 N")
        play.force_n = 2.0
        page.wait_for_timeout(3000)  # of the ten seconds in view, which a busy machine stretches
        expect(top).to_have_text("15 N")
        expect(top).to_have_text("2 N")  # slowly, once the step has left the view
        page.reload()
        expect(page.locator("#tile-traces")).to_be_visible()
        page.click("#as-bars")
        expect(page.locator("#bars .tile")).to_have_count(2)


def test_in_the_sun_every_page_is_black_on_white_whatever_the_machine_prefers(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = scripted.recorded("walk")
    with Play(scripted.node, 15.0):
        page = live(open_page(scripted.url, *PHONE, color_scheme="dark"))
        colours = """() => {
          const { color, backgroundColor } = getComputedStyle(document.body);
          return [color, backgroundColor];
        }"""
        assert page.evaluate(colours) != ["rgb(0, 0, 0)", "rgb(255, 255, 255)"]
        page.click("#sun")
        empty = """() => {
          const field = document.querySelector("#session-name");
          const { color, fontStyle } = getComputedStyle(field, "::placeholder");
          return [color, fontStyle];
        }"""
        assert page.evaluate(empty) == ["rgb(60, 67, 74)", "italic"]  # not as a value
        assert page.evaluate(colours) == ["rgb(0, 0, 0)", "rgb(255, 255, 255)"]
        expect(page.locator("#sun")).to_have_attribute("aria-pressed", "true")
        page.wait_for_function(OF_THEIR_FORCE)
        assert complaints(page) == []
        page.reload()
        assert page.evaluate(colours) == ["rgb(0, 0, 0)", "rgb(255, 255, 255)"]
        expect(page.locator(LIVE)).to_have_count(1)
        page.goto(f"{scripted.url}/nodes")
        assert page.evaluate(colours) == ["rgb(0, 0, 0)", "rgb(255, 255, 255)"]
        page.goto(f"{scripted.url}/sessions/{session.id}")
        settled(page)
        assert page.evaluate(colours) == ["rgb(0, 0, 0)", "rgb(255, 255, 255)"]
        assert complaints(page) == []
        page.click("#sun")
        assert page.evaluate(colours) != ["rgb(0, 0, 0)", "rgb(255, 255, 255)"]
        page.goto(scripted.url)
        expect(page.locator(LIVE)).to_have_count(1)
        page.emulate_media(contrast="more")
        assert complaints(page) == []


def test_the_colours_of_forces_are_said_once() -> None:
    said = [
        p.name for p in find_page_folder().rglob("*.css") if "--heat-0:" in p.read_text("utf-8")
    ]
    assert said == ["style.css"]

"""The live view shows the foot: colours, range, trail, traces, and how it fits on screens."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from service.api.app import find_page_folder
from tests.builders.arrays import make_array, make_tile
from tests.service.fake_node import FakeNode, Play
from tests.web.scripted import Scripted
from tests.web.test_accessible import complaints
from tests.web.test_live_notes import tell

pytestmark = pytest.mark.real_time

OpenPage = Callable[..., Page]
LIVE = "body[data-live=true]"

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

TOES_UP = """async () => {
  const { FootLayout, isGrid } = await import("/static/common/foot_layout.js");
  const at = (x, y) => ({ serial: "", x_m: x, y_m: y, z_m: 0 });
  const box = { widthPx: 300, heightPx: 300, roomPx: 0, toesUp: true };
  const square = [at(0, 0), at(0.01, 0), at(0, 0.01), at(0.01, 0.01)];
  const [heel, toe, left] = new FootLayout(square, box).points;
  return {
    toesAbove: toe.y < heel.y && toe.x === heel.x,
    leftLeft: left.x < heel.x && left.y === heel.y,
    grid: isGrid(square), diamond: isGrid([at(0, 0), at(0.01, 0.01), at(0.02, 0), at(0.01, -0.01)]),
    line: isGrid([at(0, 0), at(0.01, 0)]),
  };
}"""

TRACED = """() => {
  const canvas = document.querySelector("#tile-traces");
  const { width, height } = canvas;
  // A copy: of one that is read again and again Chromium complains.
  const copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0);
  const { data } = copy.getImageData(width / 2, 0, width / 2, height);
  let blue = 0;
  for (let i = 0; i < data.length; i += 4) blue += data[i + 2] - data[i] > 60 && data[i + 3] > 100;
  return blue;
}"""


def top_of(page: Page, selector: str) -> float:
    box = page.locator(selector).bounding_box()
    assert box is not None, selector
    return box["y"]


def bottom_of(page: Page, selector: str) -> float:
    box = page.locator(selector).bounding_box()
    assert box is not None, selector
    return box["y"] + box["height"]


def test_tiles_have_the_colour_of_their_force_and_the_range_says_which_it_is(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0):
        page = open_page(scripted.url)
        expect(page.locator(LIVE)).to_have_count(1)
        top = page.locator("#foot .heat-legend text").first
        expect(page.locator("#range")).to_have_text("Range: fixed")
        fixed = page.locator("#bars .scale").first.inner_text()
        page.wait_for_function(OF_THEIR_FORCE)
        before = top.text_content()
        page.click("#range")
        expect(page.locator("#range")).to_have_text("Range: auto")
        expect(top).not_to_have_text(before or "")
        expect(page.locator("#bars .scale").first).not_to_have_text(fixed)
        page.wait_for_function(OF_THEIR_FORCE)
        page.reload()
        expect(page.locator("#range")).to_have_text("Range: auto")


def test_the_centre_of_pressure_draws_a_trail_of_two_seconds(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0):
        page = open_page(scripted.url)
        expect(page.locator("#cop")).to_contain_text("COP x")
        paths = """() => [...document.querySelectorAll("#foot .cop-trail")]
          .every((part) => part.getAttribute("d").length > 40)"""
        page.wait_for_function(paths)  # the oldest part, too, is there
        kept = page.get_attribute("#foot .cop-span", "data-trail")
        assert 4 <= int(kept or 0) <= 121  # at 60 pictures a second at most


def test_from_above_toes_are_up_and_only_a_grid_is_drawn_of_squares(
    scripted: Scripted, open_page: OpenPage
) -> None:
    page = open_page(scripted.url)
    assert page.evaluate(TOES_UP) == {
        "toesAbove": True,
        "leftLeft": True,
        "grid": True,
        "diamond": False,
        "line": False,
    }


def test_a_grid_is_a_heat_map_with_readable_numbers_on_a_phone(
    scripted: Scripted, open_page: OpenPage
) -> None:
    tiles = [
        make_tile(i, x_m=0.014 * (i // 8), y_m=0.014 * (i % 8), z_m=0.0, mux=0x70 + i // 8)
        for i in range(64)
    ]

    class Grid(FakeNode):
        @property
        def info(self) -> Any:
            facts = {"node": self.name, "stream_id": self.stream_id}
            return make_array(tiles, **facts, utc_offset_ns=self.utc_offset_ns)

    scripted.node.close()
    node = Grid(scripted.running, "grid", tiles=64)
    node.connect()
    node.tared()
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
        kpa = page.locator("#bars .tile").first.get_attribute("data-value") or ""
        expect(number).to_have_text(f"{float(kpa):.1f}")
        expect(page.locator("#foot .heat-legend")).to_contain_text("kPa")
        page.click("#unit-n")
        cell = page.locator("#foot rect.dome").first.bounding_box()
        assert cell is not None
        assert cell["width"] >= 26
        assert bottom_of(page, "#foot") < top_of(page, "#actions")
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        assert complaints(page) == []
    node.close()


@pytest.mark.parametrize(
    ("places_m", "text"),
    [
        # A reference tile beside the row: drawn from above.
        (
            [(0.0, 0.012), (0.014, 0.012), (0.0, 0.04)],
            r"COP x .+ ± .+ mm \(95\s%\), y not measured",
        ),
        (
            [(0.02, -0.01), (0.02, 0.01), (0.05, 0.0)],
            r"COP y .+ ± .+ mm \(95\s%\), x not measured",
        ),
    ],
)
def test_a_row_of_tiles_draws_the_cop_on_the_row_and_gives_no_number_across_it(
    scripted: Scripted, open_page: OpenPage, places_m: list[tuple[float, float]], text: str
) -> None:
    tiles = [
        make_tile(i, x_m=x_m, y_m=y_m, reference=i == 2) for i, (x_m, y_m) in enumerate(places_m)
    ]

    class Row(FakeNode):
        @property
        def info(self) -> Any:
            facts = {"node": self.name, "stream_id": self.stream_id}
            return make_array(tiles, **facts, utc_offset_ns=self.utc_offset_ns)

    scripted.node.close()
    node = Row(scripted.running, "row", tiles=3)
    node.connect()
    node.tared()
    with Play(node, 15.0):
        page = open_page(scripted.url)
        page.select_option("#node-select", "row")
        expect(page.locator("#cop")).to_have_text(re.compile(f"^{text}$"))
        expect(page.locator("#foot .cop-symbol")).to_be_visible()
        page.goto(f"{scripted.url}/nodes")
        expect(page.locator('.node[data-node="row"][data-live="true"]')).to_have_count(1)
    node.close()


@pytest.mark.parametrize("height", [844, 740])
def test_the_first_screen_of_a_phone_has_what_matters(
    scripted: Scripted, open_page: OpenPage, height: int
) -> None:
    with Play(scripted.node, 15.0):
        page = open_page(scripted.url, 390, height)
        expect(page.locator(LIVE)).to_have_count(1)
        trouble = [f"trouble {i} that is long enough for two lines of a phone" for i in range(9)]
        tell(scripted, *trouble)
        expect(page.locator("#notes-more")).to_have_text("8 more")
        expect(page.locator("#tared")).to_have_text(re.compile("^Tared .+ ago$"))
        expect(page.locator("#fields")).to_have_text("Names …")
        bar = page.locator("#actions").bounding_box()
        assert bar is not None
        assert bar["height"] < 110  # a line of what is recorded, and the buttons
        assert bar["y"] + bar["height"] <= height
        for part in ("#notes-box", "#grf", "#tared", "#trace", "#foot", "#record"):
            assert bottom_of(page, part) <= height, part
        if height == 844:
            assert bottom_of(page, "#bars") <= bar["y"]
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


def test_tiles_are_shown_as_traces_and_this_is_remembered(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0):
        page = open_page(scripted.url)
        expect(page.locator(LIVE)).to_have_count(1)
        page.click("#as-traces")
        expect(page.locator("#bars")).to_be_hidden()
        page.wait_for_function(f"() => ({TRACED})() > 50")
        assert complaints(page) == []
        page.reload()
        expect(page.locator("#tile-traces")).to_be_visible()
        page.click("#as-bars")
        expect(page.locator("#bars .tile")).to_have_count(2)


def test_the_automatic_range_covers_the_traces_in_view(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0) as play:
        page = open_page(scripted.url)
        expect(page.locator(LIVE)).to_have_count(1)
        page.click("#as-traces")
        page.click("#range")
        expect(page.locator("#range")).to_have_text("Range: auto")
        top = page.locator("#foot .heat-legend text").first
        expect(top).to_have_text("15 N")
        play.force_n = 2.0
        page.wait_for_timeout(6000)  # of the ten seconds in view
        expect(top).to_have_text("15 N")
        expect(top).to_have_text("2 N")  # slowly, once the step has left the view


def test_in_the_sun_every_page_is_black_on_white_whatever_the_machine_prefers(
    scripted: Scripted, browser: Browser
) -> None:
    session = scripted.recorded("walk")
    with (
        Play(scripted.node, 15.0),
        browser.new_context(color_scheme="dark", viewport={"width": 390, "height": 844}) as context,
    ):
        page = context.new_page()
        page.goto(scripted.url)
        expect(page.locator(LIVE)).to_have_count(1)
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
        expect(page.locator("#plots[data-settled=true]")).to_have_count(1)
        assert page.evaluate(colours) == ["rgb(0, 0, 0)", "rgb(255, 255, 255)"]
        assert complaints(page) == []
        page.click("#sun")
        assert page.evaluate(colours) != ["rgb(0, 0, 0)", "rgb(255, 255, 255)"]
        page.goto(scripted.url)
        expect(page.locator(LIVE)).to_have_count(1)
        page.emulate_media(contrast="more")
        assert complaints(page) == []


@pytest.mark.parametrize("width", [320, 600, 1000, 2560])
def test_nothing_is_wider_than_the_screen(
    scripted: Scripted, open_page: OpenPage, width: int
) -> None:
    with Play(scripted.node, 15.0):
        page = open_page(scripted.url, width, 800)
        expect(page.locator(LIVE)).to_have_count(1)
        assert page.evaluate("document.documentElement.scrollWidth") == width


def test_the_colours_of_forces_are_said_once() -> None:
    said = [
        p.name for p in find_page_folder().rglob("*.css") if "--heat-0:" in p.read_text("utf-8")
    ]
    assert said == ["style.css"]

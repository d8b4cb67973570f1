"""How often the pages draw and write, and that what they show is of one frame."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Page, expect

from tests.service.fake_node import Play
from tests.web.scripted import Scripted

pytestmark = pytest.mark.real_time

OpenPage = Callable[..., Page]
LIVE = "body[data-live=true]"

WRITTEN = """async () => {
  const { FramePace } = await import("/static/live/pace.js");
  const pace = new FramePace();
  const node = {};
  const of = (tile_flags, force_n) =>
    ({ tile_flags, force_n, saturated: [false], frame_flags: 0, estimate_flags: 0 });
  const steady = of([0], [1]);
  return {
    first: pace.isDue(node, steady, 1000),
    same: pace.isDue(node, steady, 9000),
    another: pace.isDue(node, of([0], [2]), 9010),
    soonAfter: pace.isDue(node, of([0], [3]), 9040),
    faultAtOnce: pace.isDue(node, of([1], [null]), 9043),
    knownAgainAtOnce: pace.isDue(node, of([0], [4]), 9046),
    nodeSaysMore: pace.isDue({}, of([0], [5]), 9049),
    later: pace.isDue({}, of([0], [6]), 9300),
  };
}"""

PICTURES = """async () => {
  const { Pace } = await import("/static/live/pace.js");
  let drawn = 0;
  const pace = new Pace(() => { drawn += 1; });
  const frame = () => new Promise(requestAnimationFrame);
  for (let i = 0; i < 5; i++) pace.request();
  await frame();
  const first = drawn;
  pace.request();
  await frame();
  return [first, drawn];
}"""

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

STRIP = """async () => {
  const { Strip } = await import("/static/live/strip.js");
  const points = Array.from({ length: 400 }, (_, i) => ({ timeS: i / 20 }));
  const draw = (context, i, x) => {
    context.fillStyle = i % 7 ? "#000" : "#f00";
    context.fillRect(x(points[i].timeS) - 2, 0, 2, 10);
  };
  const how = (endS) => ({ endS, windowS: 10, widthPx: 400, heightPx: 10, key: "one" });
  const moved = new Strip();
  let drawn = 0;
  for (let n = 200; n <= 400; n += 3) {
    moved.draw(points.slice(Math.max(0, n - 201), n), how(n / 20), (context, i, x) => {
      const at = Math.max(0, n - 201) + i;
      drawn += n > 200;
      draw(context, at, x);
    });
  }
  const once = new Strip();
  once.draw(points.slice(197, 398), how(398 / 20), (context, i, x) => draw(context, 197 + i, x));
  const red = ({ canvas, context }) => {
    const row = context.getImageData(0, 5, canvas.width, 1).data;
    return [...Array(canvas.width).keys()].filter((i) => row[4 * i] > 128);
  };
  return { drawn, moved: red(moved), once: red(once) };
}"""


def test_a_frame_is_shown_ten_times_a_second_and_what_is_new_at_once(
    scripted: Scripted, open_page: OpenPage
) -> None:
    assert open_page(scripted.url).evaluate(WRITTEN) == {
        "first": True,
        "same": False,
        "another": True,
        "soonAfter": False,
        "faultAtOnce": True,
        "knownAgainAtOnce": True,
        "nodeSaysMore": True,
        "later": True,
    }


NOTE_NUMBERS = """() => {
  window.seen = [];
  const at = (id) => document.getElementById(id);
  const note = () => {
    requestAnimationFrame(note);
    const tiles = [...document.querySelectorAll("#bars .tile")];
    const written = tiles.map((tile) => Number(tile.querySelector(".value").textContent));
    const sum = (all) => all.reduce((a, b) => a + b, 0);
    window.seen.push([Number(at("grf").textContent), sum(written)]);
  };
  note();
}"""
NOTE_CARD_AND_FOOT = """
  const write = CanvasRenderingContext2D.prototype.fillText;
  let numbers = [];
  window.seen = [];
  CanvasRenderingContext2D.prototype.fillText = function (text, ...where) {
    if (this.canvas.className === "node-foot" && this.textAlign === "center") numbers.push(text);
    return write.call(this, text, ...where);
  };
  addEventListener("load", function note() {
    requestAnimationFrame(note);
    const force = document.querySelector(".node .value")?.textContent;
    const drawn = numbers.slice(-2).reduce((a, b) => a + Number(b), 0);
    if (numbers.length) window.seen.push([Number(force), drawn]);
  });
"""


def play_steps(play: Play, page: Page) -> list[list[float]]:
    """What the page has shown, in each picture, of a force that changes all the time."""
    page.wait_for_function("window.seen.length > 0")
    for force_n in (5.0, 15.0) * 10:
        play.force_n = force_n
        page.wait_for_timeout(170)
    seen: list[list[float]] = page.evaluate("window.seen.slice(1)")
    forces = [one[0] for one in seen]
    assert max(forces) - min(forces) > 15.0
    return seen


def test_force_and_numbers_of_the_tiles_are_of_one_frame(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0) as play:
        page = open_page(scripted.url)
        expect(page.locator(LIVE)).to_have_count(1)
        page.evaluate(NOTE_NUMBERS)
        for force_n, written in play_steps(play, page):
            assert written == pytest.approx(force_n, abs=0.16)


def test_force_and_foot_of_a_card_are_of_one_frame(scripted: Scripted, open_page: OpenPage) -> None:
    with Play(scripted.node, 15.0) as play:
        page = open_page(f"{scripted.url}/nodes", first=NOTE_CARD_AND_FOOT)
        expect(page.locator(".node[data-live=true]")).to_have_count(1)
        for force_n, drawn in play_steps(play, page):
            assert drawn == pytest.approx(force_n, abs=1.1)


def test_whatever_asks_for_a_picture_there_is_one_in_a_display_frame(
    scripted: Scripted, open_page: OpenPage
) -> None:
    assert open_page(scripted.url).evaluate(PICTURES) == [1, 2]


def test_bars_are_as_long_as_their_force_and_follow_the_range(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0):
        page = open_page(scripted.url)
        expect(page.locator(LIVE)).to_have_count(1)
        page.wait_for_function(BARS_OF_THEIR_FORCE)
        page.click("#range")
        page.wait_for_function(BARS_OF_THEIR_FORCE)
        page.set_viewport_size({"width": 390, "height": 844})
        page.wait_for_function(BARS_OF_THEIR_FORCE)


def test_a_picture_that_moves_on_is_that_which_is_drawn_at_once(
    scripted: Scripted, open_page: OpenPage
) -> None:
    seen = open_page(scripted.url).evaluate(STRIP)
    assert seen["drawn"] == 198  # each point once
    assert len(seen["once"]) > 20
    near = [min(abs(at - other) for other in seen["once"]) for at in seen["moved"] if at > 4]
    assert max(near) <= 1
    near = [min(abs(at - other) for other in seen["moved"]) for at in seen["once"] if at > 4]
    assert max(near) <= 1

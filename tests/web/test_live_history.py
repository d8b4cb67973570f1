"""The live trace begins with what was there before, joins it by number, and can stand still."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import pytest
from playwright.sync_api import expect

from tests.builders.arrays import PERIOD_NS
from tests.service.fake_node import Play
from tests.waiting import until
from tests.web.pages import LIVE, OpenPage, blue_px, live
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


JOINED = """async () => {
  const { Points } = await import("/static/live/points.js");
  const { recent } = await import("/static/common/api.js");
  const points = new Points();
  const socket = new WebSocket(`ws://${location.host}/api/v1/live?rate_hz=60`);
  let heard = 0;
  let joined = false;
  await new Promise((resolve) => {
    socket.onmessage = async ({ data }) => {
      const frame = JSON.parse(data);
      if (frame.type !== "frame") return;
      points.add(frame, performance.now());
      heard += 1;
      if (heard === 5) {
        const before = frame.seq_first;
        points.addHistory(await recent("bench", 10, before), before, performance.now());
        joined = true;
      }
      if (heard >= 15 && joined) resolve();
    };
  });
  socket.close();
  return points.all.map(({ seqFirst, seq, n, gap }) => [seqFirst, seq, n, gap]);
}"""
"""The page's own parts, with a socket and an answer of the server."""

OLDER = (0.1, 0.5)
"""Shares of a trace's width, right of its axis."""

PICTURE = """() => ["trace", "tracks"].map((id) => document.getElementById(id).toDataURL())
  + document.querySelector("#bars").outerHTML"""


def streamed(scripted: Scripted) -> None:
    """Some seconds up to now, that no screen has seen."""
    scripted.node.next_t_mono_ns = time.monotonic_ns() - 4000 * PERIOD_NS
    scripted.node.send(4000, 20.0)


def test_what_was_before_joins_what_is_heard_without_a_seam(
    scripted: Scripted, open_page: OpenPage
) -> None:
    streamed(scripted)
    with Play(scripted.node, 20.0):
        page = live(open_page(scripted.url))
        spans: list[Any] = page.evaluate(JOINED)
    assert len(spans) > 30
    assert spans[0][1] < scripted.node.seq - 1000
    assert {b[0] - a[1] for a, b in pairwise(spans)} == {1}
    assert all(n == last - first + 1 for first, last, n, _ in spans)


def test_a_page_that_is_opened_has_a_trace_and_traces_of_tiles_at_once(
    scripted: Scripted, open_page: OpenPage
) -> None:
    streamed(scripted)
    with Play(scripted.node, 20.0):
        page = live(open_page(scripted.url))
        opened_s = time.monotonic()
        until(lambda: blue_px(page, "#trace", *OLDER) > 100)
        assert time.monotonic() - opened_s < 3.0  # it would take five by itself
        with page.expect_response("**/history?*tiles=force_n") as asked:
            page.click("#as-traces")
        assert len(asked.value.json()["tiles"]["seq"]) > 50
        until(lambda: blue_px(page, "#tile-traces", *OLDER) > 100)
        page.select_option("#trace-window", "60")
        until(lambda: blue_px(page, "#trace", *OLDER) == 0)  # no minute was played
        page.reload()
        expect(page.locator("#trace-window")).to_have_value("60")


def test_a_paused_picture_stands_still_says_so_and_goes_on(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 20.0) as play:
        page = live(open_page(scripted.url))
        expect(page.locator("#paused")).to_be_hidden()
        expect(page.locator("#grf")).to_contain_text("40")  # before a frame nothing is held
        page.keyboard.press("p")
        expect(page.locator("#paused")).to_contain_text("Acquisition and recording continue")
        expect(page.locator("#pause-text")).to_have_text("Resume")
        page.wait_for_timeout(200)
        before, sent, grf = page.evaluate(PICTURE), play.node.seq, page.inner_text("#grf")
        play.force_n = 50.0
        page.wait_for_timeout(600)
        until(lambda: play.node.seq > sent + 100)
        assert page.evaluate(PICTURE) == before
        assert page.inner_text("#grf") == grf
        expect(page.locator(LIVE)).to_have_count(1)
        page.keyboard.press("p")
        expect(page.locator("#paused")).to_be_hidden()
        expect(page.locator("#grf")).to_contain_text("100")

"""The clock page: its code in a picture of the screen, and its text on it."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect

from service.video.clock_page import TICK_NS, make_clock_reader
from tests.service.running import Running
from tests.web.pages import PHONE, OpenPage, complaints, width_of

pytestmark = pytest.mark.real_time

STEADY = """{
  // A busy machine draws too rarely: of its intervals this screen has 60 a second.
  const real = globalThis.requestAnimationFrame.bind(globalThis);
  let drawn = 0;
  globalThis.requestAnimationFrame = (draw) => real(() => draw((drawn += 1) * 1000 / 60));
}"""
SIZES = [(1280, 720), PHONE, (375, 667), (667, 375)]


@pytest.mark.parametrize("size", SIZES, ids=[f"{width}x{height}" for width, height in SIZES])
def test_a_picture_of_the_page_has_the_servers_time(
    server: Running, open_page: OpenPage, size: tuple[int, int]
) -> None:
    page = open_page(f"{server.url}/clock", *size, first=STEADY)
    expect(page.locator("body[data-ready=true]")).to_have_count(1)
    expect(page.locator("#what")).to_have_text("Film this for two seconds.")
    expect(page.locator("#how")).to_contain_text("screen 60 Hz")
    begin_ns = time.time_ns()
    shot = page.screenshot()
    end_ns = time.time_ns()
    picture = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    reading = make_clock_reader()(picture.astype(np.uint8))
    assert reading is not None
    begin_n, end_n = (t_ns // TICK_NS for t_ns in (begin_ns, end_ns))
    slack = 1 + reading.bound_ms * 1_000_000 // TICK_NS
    assert -slack <= (reading.n - begin_n + 2**31) % 2**32 - 2**31 <= end_n - begin_n + slack
    assert reading.refresh_ms == 17
    assert width_of(page) == size[0]
    assert page.evaluate("document.documentElement.scrollHeight") <= size[1]
    assert complaints(page) == []


def test_a_screen_that_is_too_slow_is_said(server: Running, open_page: OpenPage) -> None:
    page = open_page(f"{server.url}/clock", first=STEADY.replace("1000 / 60", "1000 / 30"))
    expect(page.locator("#what")).to_contain_text("changes too rarely")
    expect(page.locator("#how")).to_contain_text("screen 30 Hz")
    assert page.get_attribute("body", "data-ready") == "false"

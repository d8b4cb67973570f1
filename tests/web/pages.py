"""What tests of the pages share: sizes of screens, a live page, and what is wrong with a page."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from axe_playwright_python.base import AXE_FILE_PATH
from playwright.sync_api import FloatRect, Locator, Page, expect

OpenPage = Callable[..., Page]
TOKEN = "a-token-of-this-test"  # noqa: S105  # of servers that ask for a login
LIVE = "body[data-live=true]"
DESK, PHONE, SMALL_PHONE = (1366, 768), (390, 844), (320, 640)
SIZES = pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
# Only what is current is asked for: rules that are off by default are experiments of axe.
_RUN_AXE = "axe.run(document, { resultTypes: ['violations'] }).then((found) => found.violations)"


def live(page: Page) -> Page:
    """The page, once it shows data."""
    try:
        expect(page.locator(LIVE)).to_have_count(1)
    except AssertionError:
        sys.stderr.write(f"{page.url} is not live, but says:\n{page.inner_text('body')}\n")
        raise
    return page


def complaints(page: Page) -> list[str]:
    """Return what axe complains of, with its elements, and that a page is wider than its screen."""
    if not page.evaluate("'axe' in globalThis"):
        page.evaluate(AXE_FILE_PATH.read_text("utf-8"))
    found: list[dict[str, Any]] = page.evaluate(_RUN_AXE)
    said = [
        f"{one['id']}: {node['target']} {node['failureSummary']}"
        for one in found
        for node in one["nodes"]
    ]
    width, screen = width_of(page), page.viewport_size
    if screen is not None and width > screen["width"]:
        said.append(f"wider than the screen: {width} px of {screen['width']} px")
    return said


def at_sizes(page: Page, *sizes: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Give the page one size after the other, by default a desk's and a phone's, and a picture."""
    for width, height in sizes or (DESK, PHONE):
        page.set_viewport_size({"width": width, "height": height})
        page.evaluate("new Promise((drawn) => requestAnimationFrame(() => setTimeout(drawn)))")
        yield width, height


def complaints_at(page: Page, *sizes: tuple[int, int]) -> list[str]:
    """Return complaints on screens of these sizes, by default a desk's and then a phone's."""
    return [f"{size}: {said}" for size in at_sizes(page, *sizes) for said in complaints(page)]


def box_of(element: Locator) -> FloatRect:
    """Where an element is, in pixels."""
    box = element.bounding_box()
    assert box is not None
    return box


def width_of(page: Page) -> int:
    """Width of all that the page shows, in pixels: that of the screen, or it scrolls sideways."""
    width: int = page.evaluate("document.documentElement.scrollWidth")
    return width


def blue_px(page: Page, canvas: str, begin: float, end: float) -> int:
    """How many pixels have a trace's colour, between these shares of a canvas's width."""
    # A copy: of one that is read again and again Chromium complains.
    found: int = page.evaluate(
        """([name, begin, end]) => {
          const canvas = document.querySelector(name);
          const [left, width] = [begin * canvas.width, (end - begin) * canvas.width];
          const copy = new OffscreenCanvas(canvas.width, canvas.height)
            .getContext("2d", { willReadFrequently: true });
          copy.drawImage(canvas, 0, 0);
          const { data } = copy.getImageData(left, 0, width, canvas.height);
          let blue = 0;
          for (let i = 0; i < data.length; i += 4) {
            blue += data[i + 2] - data[i] > 60 && data[i + 3] > 100;
          }
          return blue;
        }""",
        [canvas, begin, end],
    )
    return found

"""The API's description in a browser, from this machine alone, under the policy of all pages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.service.running import Running
from tests.web.pages import TOKEN

pytestmark = pytest.mark.real_time


@pytest.fixture
def private(tmp_path: Path) -> Iterator[Running]:
    running = Running(tmp_path / "private", token=TOKEN, is_private=True)
    running.start()
    yield running
    running.stop()


def test_the_description_is_drawn_and_tried_out_by_who_has_logged_in(
    private: Running, open_page: Callable[..., Page]
) -> None:
    page = open_page("about:blank")
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{private.url}/docs")
    expect(page.locator("#token-why")).to_contain_text("This server is private")
    expect(page.locator(".opblock")).to_have_count(0)
    page.fill("#token-field", TOKEN)
    page.press("#token-field", "Enter")
    expect(page.locator("#operations-sessions-startSession")).to_be_visible()
    expect(page.locator(".version-stamp")).to_have_text("OAS 3.1")

    # A request of its own, with the cookie: as from any page of ours.
    index = page.locator("#operations-server-getVersion")
    index.locator(".opblock-summary").click()
    index.locator(".try-out__btn").click()
    index.locator("button.execute").click()
    expect(index.locator(".live-responses-table .response-col_status").last).to_contain_text("200")
    expect(index.locator(".live-responses-table")).to_contain_text("foottile")
    ours = ("about:", "data:", "blob:", private.url)
    assert [url for url in asked if not url.startswith(ours)] == []

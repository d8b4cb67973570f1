"""The pages as an app: the server's present files, or a page that says that there is no server."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

import service.api.app
from service.api.app import find_page_folder
from tests.waiting import until
from tests.web.pages import PHONE, TOKEN, OpenPage, complaints
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

CONTROLLED = "navigator.serviceWorker.controller?.state === 'activated'"


def installed(page: Page) -> Page:
    """The page, once the service worker serves it."""
    until(lambda: page.evaluate(CONTROLLED))
    return page


def test_the_manifest_names_files_that_exist_with_their_types(scripted: Scripted) -> None:
    http, url = scripted.running.http, scripted.url
    for page in ("/", "/nodes", "/sessions", "/sessions/x", "/calibrate", "/clock", "/docs"):
        assert 'rel="manifest"' in http.get(url + page).text
    manifest = http.get(f"{url}/static/manifest.webmanifest")
    assert manifest.headers["content-type"].startswith("application/manifest+json")
    assert manifest.json()["start_url"] == "/"
    for icon in manifest.json()["icons"]:
        answer = http.get(url + icon["src"])
        assert answer.headers["content-type"].startswith(icon["type"])
        assert answer.status_code == 200
    worker = http.get(f"{url}/worker.js")
    assert worker.headers["content-type"].startswith("text/javascript")


def test_after_an_update_the_first_load_is_of_the_new_files(
    script: Callable[..., Scripted],
    open_page: OpenPage,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = tmp_path / "web"
    shutil.copytree(find_page_folder(), folder)
    monkeypatch.setattr(service.api.app, "find_page_folder", lambda: folder)
    page = installed(open_page(f"{script().url}/nodes"))
    for name, old, new in (
        ("nodes.html", "<h1>All nodes</h1>", "<h1>Every node</h1>"),
        ("nodes/page.js", "of ${all.length} live", "of ${all.length} live, new"),
        ("common/text.js", "// Helpers", "document.body.dataset.new = 'true'; // Helpers"),
    ):
        text = (folder / name).read_text("utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new), "utf-8")
    page.reload()
    expect(page.locator("h1")).to_have_text("Every node")
    expect(page.locator("body[data-new=true]")).to_have_count(1)


def test_without_a_server_a_page_says_so_and_returns_by_itself(
    scripted: Scripted, open_page: OpenPage
) -> None:
    page = installed(open_page(f"{scripted.url}/nodes", *PHONE))
    stored = "caches.open('foottile-offline-1').then((c) => c.keys()).then((k) => k.length)"
    assert page.evaluate(stored) == 3
    scripted.running.stop()
    page.reload()
    expect(page.locator("h1")).to_have_text("The FootTile server cannot be reached")
    expect(page.locator("#cards")).to_have_count(0)
    # Axe objects to a page that loads itself again, in any time: there is nothing to read on.
    assert [one for one in complaints(page) if "meta-refresh" not in one] == []
    scripted.running.start()
    expect(page.locator("h1")).to_have_text("All nodes")


def test_a_private_server_lets_an_installed_page_log_in(
    script: Callable[..., Scripted], open_page: OpenPage
) -> None:
    scripted = script(token=TOKEN, is_private=True)
    page = installed(open_page(f"{scripted.url}/nodes#ticket={scripted.ticket()}"))
    expect(page.locator("#login")).to_have_text("viewer (read-only)")
    page.goto(f"{scripted.url}/")
    expect(page.locator("#node-name")).to_have_text("bench")
    assert page.evaluate("fetch('/api/v1/nodes').then((answer) => answer.status)") == 200

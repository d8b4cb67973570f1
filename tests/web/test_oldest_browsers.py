"""The pages work in the oldest browsers that we name, and over plain HTTP in a network."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.service.fake_node import Play
from tests.service.running import Running
from tests.tokens import SHARED_TOKEN
from tests.waiting import until
from tests.web.pages import SIZES, OpenPage, live
from tests.web.scripted import Scripted
from tests.web.session_page import settled

ROOT = Path(__file__).resolve().parents[2]
OLDEST = json.loads((ROOT / "scripts" / "browsers.json").read_text("utf-8"))["oldest"]
NEWER = (ROOT / "tests" / "web" / "newer_features.json").read_text("utf-8")
_DELETE = """
for (const [of, names] of Object.entries(newer)) {
  const owner = globalThis[of];
  for (const name of names ?? Object.getOwnPropertyNames(owner?.prototype ?? {})) {
    const bare = name.replace(/_static$/, "");
    for (const home of [owner, owner?.prototype, of === "Window" ? globalThis : null]) {
      if (home && Object.hasOwn(home, bare)) Reflect.deleteProperty(home, bare);
    }
  }
  if (names === null) Reflect.deleteProperty(globalThis, of);
}"""
WITHOUT_NEWER = f"{{ const newer = {NEWER}; {_DELETE} }}"
WITHOUT_STORAGE = """
for (const name of ["localStorage", "sessionStorage"]) {
  const get = () => { throw new DOMException("of this test", "SecurityError"); };
  Object.defineProperty(globalThis, name, { get });
}
"""
"""Deletes what the newest Chrome has and one of our oldest browsers lacks."""


def test_what_is_too_new_is_deleted_in_these_tests(server: Running, open_page: OpenPage) -> None:
    page = open_page(f"{server.url}/nodes", first=WITHOUT_NEWER)
    left = page.evaluate("""() => [
      AbortSignal.any, Promise.withResolvers, Array.fromAsync, Object.groupBy,
      [].toSorted, new Set().union, new Map().values().map, "".isWellFormed, URL.canParse,
      globalThis.requestIdleCallback, document.body.showPopover, document.body.ariaBusy,
      document.startViewTransition, new URLSearchParams().size,
    ].map((it) => typeof it)""")
    assert set(left) == {"undefined"}
    assert page.evaluate("typeof [].at + typeof structuredClone") == "functionfunction"


@pytest.mark.parametrize(
    "path",
    ["docs/session-page.md", "CONTRIBUTING.md", "web/guard.js"],
    ids=["document", "contributing", "page"],
)
def test_the_oldest_browsers_are_the_same_everywhere(path: str) -> None:
    text = " ".join((ROOT / path).read_text("utf-8").split())
    found = re.search(
        r"Chrome, Edge or Android.s browser (\d+), Firefox (\d+),? or Safari (\d+) \(iOS (\d+)\)",
        text,
    )
    assert found, path
    chrome, firefox, safari, ios = found.groups()
    stated = dict.fromkeys(("chrome", "chrome_android", "edge"), chrome)
    stated |= dict.fromkeys(("firefox", "firefox_android"), firefox)
    assert stated | {"safari": safari, "safari_ios": ios} == OLDEST


@SIZES
@pytest.mark.real_time
@pytest.mark.slow
def test_an_old_browser_in_a_network_records_markers_and_looks_back(
    scripted: Scripted, open_page: OpenPage, size: tuple[int, int]
) -> None:
    address = scripted.url.replace("127.0.0.1", "192.0.2.1")
    with Play(scripted.node, alive=True) as play:
        link = f"{address}/#token={SHARED_TOKEN}"
        page = live(open_page(link, *size, first=WITHOUT_NEWER + WITHOUT_STORAGE))
        assert not page.evaluate("isSecureContext")
        page.click("#tare")
        expect(page.locator("#notices")).to_contain_text("Tared")
        page.click("#record")
        expect(page.locator("#recordings li")).to_have_count(1)
        play.force_n = 8.0
        page.click("#marker")
        expect(page.locator("#notices")).to_contain_text("Marker")
        page.click("#as-traces")
        expect(page.locator("#tile-traces")).to_be_visible()
        until(lambda: scripted.running.sessions()[0]["frames"] > 300)
        play.force_n = 0.0
        until(lambda: scripted.running.sessions()[0]["frames"] > 600)
        page.click("#stop")
        until(lambda: scripted.running.sessions()[0]["state"] == "sealed")
        page.click("#to-sessions")
        page.click("#sessions .session-name")
        settled(page)
        page.click("#zoom-in")
        expect(page).to_have_url(re.compile("from="))
        page.click("#zoom-all")
        expect(page).not_to_have_url(re.compile("from="))
        expect(page.locator("#markers-list li")).to_have_count(1)
        expect(page.locator("#stance-line")).to_be_visible()
        page.click("#ledger-card summary")
        page.click("#verify")
        expect(page.locator("#verified p")).to_have_attribute("data-whole", "true")
        page.click("#play")
        expect(page.locator("#replay")).to_have_attribute("data-waiting", "false")

        page.goto(f"{address}/nodes")
        page.click("#record-all")
        expect(page.locator("#take-text")).to_be_visible()
        page.click("#marker-all")
        expect(page.locator("#notices")).to_contain_text("Marker")
        page.click("#stop-all")
        expect(page.locator("#take-text")).to_be_hidden()
    expect(page.locator("#guard")).to_have_count(0)

"""No name changes how a page reads: controls and invisible characters are spelt out."""

from __future__ import annotations

import json
import unicodedata

import pytest
from playwright.sync_api import Page, expect

from tests.service.fake_node import Play
from tests.web.pages import OpenPage, live
from tests.web.scripted import Scripted
from tests.web.session_page import settled

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

HOSTILE = "x\x1b[2J\x07\u202ecba\u2066\u200b\ufeff\u00ad\ud800\u2028end"
SHOWN = r"x\x1b[2J\x07\u202ecba\u2066\u200b\ufeff\xad\ud800\u2028end"
_READ = """() => [document.title, document.body.innerText,
  ...[...document.querySelectorAll("[aria-label], [title], [label]")].flatMap(
    (e) => ["aria-label", "title", "label"].map((name) => e.getAttribute(name) ?? "")),
  ...[...document.querySelectorAll("text, option")].map((e) => e.textContent)]"""


def unprintable(page: Page) -> list[str]:
    """Characters without a picture of their own in all that a page shows or has read out."""
    kinds = ("Cc", "Cf", "Cs", "Zl", "Zp")
    texts = page.evaluate(_READ)
    return [
        f"{char!r} in {text[:80]!r}"
        for text in texts
        for char in text
        if unicodedata.category(char) in kinds and char not in "\n\r\t"
    ]


def test_hostile_names_are_spelt_out_wherever_they_are_shown(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = scripted.recorded("walk")
    answer = scripted.running.http.post(f"{session.url}/markers", json={"label": "walk"})
    assert answer.status_code == 201
    fields = {"subject": "walk", "tags": ["walk"], "notes": "walk"}
    assert scripted.running.http.patch(session.url, json=fields).status_code == 200
    first = f"""
      const parse = JSON.parse;
      const hostile = {json.dumps(json.dumps(HOSTILE))};
      JSON.parse = (text) => parse(text.replaceAll(/"(?:walk|T01)"/g, () => hostile));
    """

    with Play(scripted.node, 5.0):
        page = live(open_page(scripted.url, first=first))
        expect(page.locator("#last-session a")).to_have_text(SHOWN)
        expect(page.locator("#bars .serial").first).to_have_text(SHOWN)
        assert unprintable(page) == []
        page.click("#as-traces")
        page.goto(f"{scripted.url}/sessions")
        expect(page.locator("#sessions .session-name")).to_have_text(SHOWN)
        assert unprintable(page) == []
        page.goto(f"{scripted.url}/nodes")
        expect(page.locator(".node[data-live=true]")).to_have_count(1)
        assert unprintable(page) == []
        page.goto(f"{scripted.url}/sessions/{session.id}")
        settled(page)
        expect(page.locator("#name")).to_have_text(SHOWN)
        expect(page.locator("#markers-list")).to_contain_text(SHOWN)
        expect(page.locator("#about")).to_contain_text(f"#{SHOWN}")
        assert unprintable(page) == []

"""Each warning says since when it stands, and why it is there, in two sentences."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.service.fake_node import Play
from tests.web.pages import OpenPage, complaints, live
from tests.web.scripted import Scripted

LIVE_JS = Path(__file__).resolve().parents[2] / "web" / "live"


def reasons() -> dict[str, str]:
    """Reason and remedy of each warning, by its key."""
    text = (LIVE_JS / "why.js").read_text("utf-8")
    return dict(
        re.findall(r"^  (\w+): \{[^\"]*(?:\"[a-z-]+\",)?\s+why: \"(.+)\" \},$", text, re.MULTILINE)
    )


def test_every_flag_of_frames_and_estimates_is_explained() -> None:
    notes = (LIVE_JS / "notes.js").read_text("utf-8")
    keys = re.findall(r"\[(?:ESTIMATE|FRAME)\.\w+, \"(\w+)\", ", notes)
    keys += re.findall(r"(?:add|flag|makeNote)\(\"(\w+)\", ", notes)
    assert len(keys) > 15
    assert set(keys) <= set(reasons())


@pytest.mark.parametrize("why", reasons().values(), ids=reasons())
def test_an_explanation_has_two_sentences_in_plain_words(why: str) -> None:
    assert re.fullmatch(r"[A-Z][^.]+\. [A-Z][^.]+\.", why), why
    assert "slot" not in why


def test_a_warning_links_to_a_section_that_is_there() -> None:
    sections = re.findall(r'section: "([a-z-]+)"', (LIVE_JS / "why.js").read_text("utf-8"))
    assert len(sections) > 3
    help_page = (LIVE_JS.parent / "tile-reads-nonsense.html").read_text("utf-8")
    assert set(sections) <= set(re.findall(r'<h2 id="([a-z-]+)">', help_page))


@pytest.mark.real_time
@pytest.mark.slow
def test_a_warning_says_since_when_and_why_and_stays_open(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node):
        page = live(open_page(scripted.url))
        page.wait_for_timeout(3200)
        tare_id = scripted.running.node()["tare"]["id"]
        assert scripted.running.http.delete(f"/nodes/bench/tares/{tare_id}").status_code == 204
        note = page.locator("#notes li", has_text="Not tared")
        expect(note.locator("time")).to_have_text(re.compile(r" since \d\d:\d\d:\d\d$"))
        since = note.locator("time").text_content()
        note.get_by_text("Why?").click()
        expect(note.locator("p")).to_contain_text("Lift the foot and press Tare")
        with page.expect_popup() as opened:
            note.get_by_role("link", name="Troubleshooting").click()
        expect(opened.value.locator("#a-force-in-the-air")).to_be_in_viewport()
        assert complaints(opened.value) == []
        scripted.tell("another trouble")
        expect(page.locator("#notes")).to_contain_text("Another trouble.")
        expect(note.locator("p")).to_be_visible()
        assert note.locator("time").text_content() == since
        assert complaints(page) == []
        page.reload()
        expect(note.locator("time")).to_contain_text("or earlier")

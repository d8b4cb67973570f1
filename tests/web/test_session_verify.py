"""A session's files are checked from its page, and what is found is said in plain words."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from tests.web.pages import OpenPage, complaints
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


def test_what_a_check_of_the_files_finds_is_said_in_plain_words(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = scripted.recorded("walk")
    page = open_page(f"{scripted.url}/sessions/{session.id}")
    page.click("#ledger-card summary")
    now = session.now()
    for said in (
        f"{now['frames']:,} frames recorded.",
        "complete from first to last",
        now["sha256"],
    ):
        expect(page.locator("#ledger")).to_contain_text(said)
    page.click("#verify")
    found = page.locator("#verified")
    expect(found.locator("[data-whole=true]")).to_contain_text("are consistent.")
    expect(found).to_contain_text(f"all {now['frames']:,} frames read again")
    assert complaints(page) == []
    path = session.folder / "clock.parquet"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    page.click("#verify")
    expect(found.locator("[data-whole=false]")).to_contain_text("files are damaged")
    expect(found.locator("li")).to_contain_text("clock.parquet")
    assert complaints(page) == []


def test_of_a_session_whose_frames_are_damaged_the_page_says_so_and_what_to_do(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = scripted.recorded("walk")
    path = session.folder / "frames.parquet"
    content = bytearray(path.read_bytes())
    content[4 : len(content) // 2] = bytes(len(content) // 2 - 4)
    path.write_bytes(content)
    (session.folder / "overview.arrow").unlink()
    page = open_page(f"{scripted.url}/sessions/{session.id}", may_complain=True)  # of 500
    expect(page.locator("#state")).to_have_text("files damaged")
    expect(page.locator("#message")).to_contain_text("“Verify files”")
    page.click("#verify")
    expect(page.locator("#verified [data-whole=false]")).to_be_visible()
    expect(page.locator("#verified")).to_contain_text("frames.parquet")
    assert complaints(page) == []

"""On the page of a session of a take: all of its sessions in one file."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from storage.formats.writers.registry import MULTI_SESSION_FORMATS
from tests.service.fake_node import FakeNode
from tests.service.running import Running
from tests.service.takes import Take, frames_of_long_ago
from tests.storage.formats.writers.readers import said_in
from tests.web.pages import OpenPage, complaints


@pytest.fixture
def take(server: Running, monkeypatch: pytest.MonkeyPatch) -> Take:
    frames_of_long_ago(monkeypatch)
    feet = [FakeNode(server, name) for name in ("left", "right")]
    made = Take(server, feet).sealed()
    for foot in feet:
        foot.close()
    return made


def test_the_others_of_a_take_come_in_the_same_file(take: Take, open_page: OpenPage) -> None:
    page = open_page(f"{take.running.url}/sessions/{take.sessions[0].id}?from=0&to=0.1")
    expect(page.locator("#plots[data-settled=true]")).to_have_count(1)
    expect(page.locator("#download-take-text")).to_contain_text("right")  # it moves the others
    page.click("#downloads-more summary")
    together = page.get_by_label("whole take in one file (with right)")
    offered = page.locator("#download-list [data-format]:visible")
    everything = offered.count()
    together.check()
    names = offered.evaluate_all("items => items.map((item) => item.dataset.format)")
    assert set(names) == set(MULTI_SESSION_FORMATS)
    assert everything == len(names)  # the others stand in the page, and are of this session only
    assert complaints(page) == []
    with page.expect_download() as download:
        page.click("#download-mcap")
    assert download.value.suggested_filename == f"both_take-{take.id}_0.000s-to-0.100s.mcap"
    said = said_in("mcap", download.value.path().read_bytes())
    assert [(each["node"], each["end_s"]) for each in said] == [("left", "0.1"), ("right", "0.1")]
    with page.expect_download() as alone:
        page.click("#download-csv")
    assert alone.value.suggested_filename == f"both_{take.sessions[0].id}_0.000s-to-0.100s.csv"
    together.uncheck()
    with page.expect_download() as one:
        page.click("#download-mcap")
    assert one.value.suggested_filename == f"both_{take.sessions[0].id}_0.000s-to-0.100s.mcap"

"""On the page of a session of a take: all of its sessions in one file."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from storage.formats.writers.registry import MULTI_SESSION_FORMATS
from tests.builders.arrays import PERIOD_NS
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


LATER_S = 0.125
"""First frame of the right foot after the left one's."""


@pytest.fixture(scope="module")
def apart(server: Running) -> Take:
    feet = [FakeNode(server, name) for name in ("early", "late")]
    feet[1].utc_offset_ns = feet[0].utc_offset_ns
    feet[1].next_t_mono_ns = feet[0].next_t_mono_ns + round(LATER_S * 1e9)
    with pytest.MonkeyPatch.context() as patch:
        frames_of_long_ago(patch)
        made = Take(server, feet).sealed()
    for foot in feet:
        foot.close()
    return made


def test_two_feet_of_a_take_lie_by_the_servers_clock_and_the_picture_says_so(
    apart: Take, open_page: OpenPage
) -> None:
    left, right = apart.sessions
    for own, other, shift_s in ((left, right, LATER_S), (right, left, -LATER_S)):
        page = open_page(f"{apart.running.url}/sessions/{own.id}?with={other.id}")
        says = page.locator("#beside-summary")
        expect(says).to_contain_text(
            "(of the same take): aligned by the server's clock (shifted by"
        )
        moved_s = float(says.get_attribute("data-shift-s") or "nan")
        assert moved_s == pytest.approx(shift_s, abs=1e-4)
        expect(page.locator("#legend [data-kind=beside]")).to_contain_text(
            "aligned by the server's clock"
        )
        assert page.locator("#beside-align option").first.get_attribute("value") == "clock"
        page.select_option("#beside-align", "start")
        expect(says).to_contain_text("first frame, which may be tenths of a second apart")
        expect(page.locator("#legend [data-kind=beside]")).to_contain_text("first frame")
        assert complaints(page) == []


def test_the_visible_range_of_a_take_is_one_range_of_the_servers_clock(
    apart: Take, open_page: OpenPage
) -> None:
    page = open_page(f"{apart.running.url}/sessions/{apart.sessions[1].id}?from=0.02&to=0.06")
    expect(page.locator("#plots[data-settled=true]")).to_have_count(1)
    page.click("#downloads-more summary")
    link = page.locator("#download-mcap")
    expect(link).to_have_attribute("href", re.compile(r"start_s=0\.020000&end_s=0\.060000"))
    page.get_by_label("whole take in one file").check()
    expect(link).to_have_attribute("href", re.compile(r"start_s=0\.145\d+&end_s=0\.185\d+"))


def test_a_gap_too_long_to_fill_is_said_and_the_file_may_end_before_it(
    server: Running, open_page: OpenPage
) -> None:
    node = FakeNode(server, "gappy")
    node.connect()
    node.tared()
    session = node.record()
    for slots in (14, 100, 0):  # a gap of 30 ms, and one of 202 ms
        node.send(250, [30.0, 65.0], alive=True)
        node.next_t_mono_ns += slots * PERIOD_NS
    node.deliver(1, [30.0, 65.0])
    node.finish(session)
    node.close()
    page = open_page(f"{session.running.url}/sessions/{session.id}")
    expect(page.locator("#plots[data-settled=true]")).to_have_count(1)
    page.click("#downloads-more summary")
    page.click("#download-opensim")
    expect(page.locator("#notices .bad")).to_contain_text(
        "too long for a line, the longest 0.202 s"
    )
    page.get_by_label("may end before a long gap").check()
    with page.expect_download() as download:
        page.click("#download-opensim")
    assert download.value.suggested_filename.endswith(".opensim.zip")
    expect(page.locator("#notices")).to_contain_text("1 gaps of the force are straight lines")
    expect(page.locator("#notices")).to_contain_text("before a gap of 0.202 s")
    assert complaints(page) == []

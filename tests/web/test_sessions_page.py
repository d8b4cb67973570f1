"""Sessions on the page: several at once, losses in words, markers that wait, the trash."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.service.fake_node import FakeNode, Play
from tests.waiting import until
from tests.web.pages import DESK, PHONE, OpenPage, at_sizes, box_of, complaints_at, live
from tests.web.scripted import Scripted
from tests.web.session_rows import choose, open_menu, row_of

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


def test_recordings_that_run_at_once_are_all_shown_marked_and_stopped_one_by_one(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node):
        page = live(open_page(scripted.url))
        for name, button in (("first", "#record"), ("second", "#another")):
            page.fill("#session-name", name)
            page.click(button)
            expect(page.locator("#recordings")).to_contain_text(name)
            time.sleep(1.0)  # within it a press is the second of a double tap
        expect(page.locator("#recordings li")).to_have_count(2)
        page.fill("#marker-label", "a stone")
        page.click("#marker")
        expect(page.locator("#notices")).to_contain_text("Marker")
        page.get_by_role("button", name="Stop first").click()
        expect(page.locator("#recordings li")).to_have_count(1)
        expect(page.locator("#recordings")).to_contain_text("second")
        page.click("#stop")
        expect(page.locator("#recordings")).to_be_hidden()
        sessions = scripted.running.sessions
        until(lambda: {s["state"] for s in sessions()} == {"sealed"})
    for session in sessions():
        markers = scripted.running.http.get(f"/sessions/{session['id']}/markers").json()["items"]
        assert [event["label"] for event in markers] == ["a stone"]


def test_a_marker_that_is_set_while_the_server_is_away_has_the_instant_of_the_press(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = scripted.node.record(name="walk")
    with Play(scripted.node):
        page = live(open_page(scripted.url))
        expect(page.locator("#marker")).to_be_enabled()
        time.sleep(1.5)  # a heartbeat says what time it is
    scripted.running.stop()
    expect(page.locator("body")).to_have_attribute("data-live", "false")
    page.fill("#marker-label", "a stone")
    before_ns = time.time_ns()
    page.click("#marker")
    after_ns = time.time_ns()
    expect(page.locator("#waiting-markers")).to_contain_text("1 marker not sent yet")
    expect(page.locator("#waiting-markers")).to_contain_text("a stone")
    expect(page.locator("#waiting-markers")).to_contain_text("Closing this page loses it")
    time.sleep(1.5)
    scripted.running.start()
    expect(page.locator("#waiting-markers")).to_be_hidden()
    [event] = scripted.running.http.get(f"{session.url}/markers").json()["items"]
    assert event["label"] == "a stone"
    assert before_ns - 1_000_000_000 < event["t_ns"] < after_ns + 1_000_000_000


def test_a_deleted_session_can_be_had_back_at_once_or_from_the_trash_until_it_is_emptied(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = scripted.recorded("walk")
    page = open_page(f"{scripted.url}/sessions")
    other = open_page(f"{scripted.url}/sessions")
    row = row_of(page, session)
    choose(page, row, "Delete")
    expect(row).to_have_count(0)
    legends = [one.locator("#trash-legend") for one in (page, other)]
    for legend in legends:
        expect(legend).to_have_text("1 session, can be restored")
    page.locator("#notices").get_by_role("button", name="Undo").click()
    expect(row).to_have_count(1)
    for legend in legends:
        expect(legend).to_have_text("empty")
    choose(page, row, "Delete")
    expect(row).to_have_count(0)
    page.locator("#trash-card summary").click()
    trashed = page.locator(f'#trash [data-session-id="{session.id}"]')
    expect(trashed).to_contain_text("walk")
    expect(page.locator("#sessions .none")).to_have_text("No sessions; 1 in the trash.")
    said = page.locator("#notices .notice", has_text="is in the trash")
    expect(said).to_have_count(1)
    trashed.get_by_role("button", name="Restore").click()
    expect(trashed).to_have_count(0)
    expect(said).to_have_count(0, timeout=4000)  # it would leave by itself after 10 s
    expect(row).to_have_count(1)
    choose(page, row, "Delete")
    expect(trashed).to_have_count(1)
    page.click("#trash-empty")
    page.get_by_role("button", name="Cancel").click()
    expect(trashed).to_have_count(1)
    page.click("#trash-empty")
    page.get_by_role("button", name="Delete 1 session").click()
    expect(trashed).to_have_count(0)
    assert scripted.running.http.get("/trash").json()["items"] == []


def test_a_pending_session_says_what_it_waits_for_and_can_be_sealed_without_it(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = scripted.pending("walk")
    page = open_page(f"{scripted.url}/sessions")
    row = row_of(page, session)
    expect(row).to_contain_text("100 frames still on the node")
    choose(page, row, "Abandon missing frames")
    expect(page.locator("#ask-dialog")).to_contain_text("100 frames will be lost for good")
    page.get_by_role("button", name="Seal as lossy").click()
    expect(row.locator(".state")).to_have_text("lossy")
    expect(row).to_contain_text("100 frames: session sealed without them")
    expect(open_menu(page, row).get_by_role("menuitem", name="Abandon")).to_have_count(0)


def test_a_complete_session_says_how_much_was_not_sampled(
    scripted: Scripted, open_page: OpenPage
) -> None:
    node = scripted.node
    with Play(node):
        session = node.record(name="walk")
        time.sleep(0.5)
        node.socket.send(json.dumps({"type": "status", "missed_slots": 1000, "warnings": []}))
        until(lambda: scripted.running.node()["missed_slots"] == 1000)
        during = open_page(f"{scripted.url}/sessions/{session.id}")
        expect(during.locator("#state")).to_have_text(re.compile("^recording, .+ not sampled$"))
        session.stop()
        sealed = session.sealed()
    assert sealed["complete"] is True
    share = f"complete, {100 * 1000 / (1000 + sealed['frames']):.0f}\u00a0% not sampled"
    counts = "0 lost, 1,000 not sampled"
    page = open_page(f"{scripted.url}/sessions")
    expect(row_of(page, session).locator(".state")).to_have_text(share)
    expect(row_of(page, session).locator(".c-state")).to_contain_text(counts)
    expect(row_of(page, session).locator(".state")).to_have_attribute(
        "title", "Complete: every frame that the node sampled is stored."
    )
    page.goto(scripted.url)
    expect(page.locator("#last-session")).to_contain_text(share)
    page.goto(f"{scripted.url}/sessions/{session.id}")
    expect(page.locator("#state")).to_have_text(share)
    expect(page.locator("#state-why")).to_contain_text(counts)
    page.click("#help")
    expect(page.locator("#help-dialog")).to_contain_text("Not sampled: the node")


def test_losses_troubles_and_what_is_behind_are_said_in_words(
    scripted: Scripted, open_page: OpenPage
) -> None:
    node = scripted.node
    first = node.seq
    node.frames(1000)
    with Play(node):
        node.say_lost(disk_full=[[first, first + 1]], evicted=[[first + 2, first + 101]])
        status = {"type": "status", "missed_slots": 3, "warnings": ["the node's disk is full"]}
        node.socket.send(json.dumps(status))
        page = live(open_page(scripted.url))
        expect(page.locator("#lost")).to_have_text("102 lost, 3 not sampled")
        expect(page.locator("#backlog")).to_have_text("898 frames")
        notes = page.locator("#notes")
        expect(notes).to_contain_text("Lost 2 frames: node disk full.")
        expect(notes).to_contain_text("Lost 100 frames: link down longer than")
        expect(notes).to_contain_text("The node's disk is full.")


def test_what_is_said_of_a_session_can_be_changed(scripted: Scripted, open_page: OpenPage) -> None:
    session = scripted.recorded("walk")
    page = open_page(f"{scripted.url}/sessions")
    row = row_of(page, session)
    choose(page, row, "Edit")
    page.fill("#edit-name", "mud & <b>stones</b>")
    page.fill("#edit-subject", "leg 2")
    page.fill("#edit-tags", "wet,  slow ,")
    page.fill("#edit-notes", "first line\nsecond")
    page.get_by_role("button", name="Save").click()
    expect(row).to_contain_text("mud & <b>stones</b>")
    expect(row.locator(".subject")).to_have_text("leg 2")
    expect(row.locator(".tag")).to_have_text(["#wet", "#slow"])
    found = session.now()
    assert (found["subject"], found["tags"]) == ("leg 2", ["wet", "slow"])
    assert found["notes"] == "first line\nsecond"


TAPS = """async () => {
  const record = document.querySelector("#record");
  record.click();
  record.click();
  while (!document.querySelector("#recordings li")) await new Promise(requestAnimationFrame);
  document.dispatchEvent(new KeyboardEvent("keydown", { key: "r" }));
}"""
"""Three presses of one second: sent one by one to a page on a busy machine they may take longer."""


def test_a_double_tap_records_once_and_stop_ends_all_recordings_of_the_node(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node):
        page = live(open_page(scripted.url))
        page.evaluate(TAPS)
        expect(page.locator("#recordings li")).to_have_count(1)
        time.sleep(1.0)  # no double tap any more
        assert len(scripted.running.sessions()) == 1
        expect(page.locator("#stop-text")).to_have_text("Stop")
        page.keyboard.press("r")
        expect(page.locator("#stop-text")).to_have_text("Stop all 2")
        page.click("#stop")
        expect(page.locator("#notices")).to_contain_text("Stopped 2 recordings.")
        expect(page.locator("#recordings li")).to_have_count(0)
    assert "recording" not in {session["state"] for session in scripted.running.sessions()}


def test_a_phone_has_room_for_several_recordings_and_all_buttons(
    scripted: Scripted, open_page: OpenPage
) -> None:
    scripted.recorded("before")
    with Play(scripted.node):
        for name in ("first", "second", "third"):
            scripted.node.record(name=name)
        page = live(open_page(scripted.url, 390, 844))
        expect(page.locator("#recordings li")).to_have_count(3)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        for button in ("#tare", "#another", "#stop", "#marker"):
            expect(page.locator(button)).to_be_in_viewport()


def test_a_session_shows_how_many_markers_it_has_and_its_downloads_have_them(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = scripted.recorded("walk")
    page = open_page(f"{scripted.url}/sessions")
    markers = row_of(page, session).locator(".c-markers")
    expect(markers).to_have_text("0")
    t_ns = int(session.column("t_ns")[3])
    body = {"label": "a stone", "t_ns": t_ns}
    assert scripted.running.http.post(f"{session.url}/markers", json=body).status_code == 201
    expect(markers).to_have_text("1")
    for kind in ("parquet", "arrow", "csv"):
        with page.expect_download() as download:
            open_menu(page, row_of(page, session)).locator(f'[data-part="{kind}"]').click()
        content = Path(download.value.path()).read_bytes()
        assert content == session.data(format=kind, markers="true").content
        assert b"a stone" in content


def test_sessions_of_a_take_are_listed_together_and_compared_from_the_menu(
    scripted: Scripted, open_page: OpenPage
) -> None:
    other = FakeNode(scripted.running, "other")
    other.connect()
    other.tared()
    with Play(scripted.node), Play(other):
        take = scripted.running.http.post("/takes", json={"name": "both"}).json()
        time.sleep(0.3)
        scripted.node.record(name="alone").stop()
        scripted.running.http.post(f"/takes/{take['id']}/stop")
        sessions = scripted.running.sessions
        until(lambda: {s["state"] for s in sessions()} == {"sealed"})
    first, second = (one["id"] for one in sorted(take["sessions"], key=lambda one: one["node"]))
    fields = {"subject": "leg 2", "tags": ["wet"], "notes": "slow"}
    assert scripted.running.http.patch(f"/sessions/{first}", json=fields).status_code == 200
    page = open_page(f"{scripted.url}/sessions", *PHONE)
    expect(page.locator("#sessions .session")).to_have_count(3)
    expect(page.locator("#sessions .take")).to_contain_text("2 nodes: bench, other")
    order = "rows => rows.map((row) => row.dataset.take ?? row.dataset.sessionId)"
    lines = page.locator("#sessions :is(.take, .session)").evaluate_all(order)
    at = lines.index(take["id"])
    assert lines[at : at + 3] == [take["id"], first, second]
    assert complaints_at(page, DESK, PHONE) == []
    page.get_by_role("checkbox", name="Select the take both").check()
    expect(page.locator("#chosen-text")).to_have_text("2 selected")
    page.locator(f'[data-session-id="{second}"] input').uncheck()
    expect(page.locator("#chosen-text")).to_have_text("1 selected")
    assert page.locator(".take input").evaluate("box => box.indeterminate")
    row = page.locator(f'#sessions [data-session-id="{first}"]')
    for width, _ in at_sizes(page, DESK, PHONE):
        menu = open_menu(page, row)
        box = box_of(menu)
        assert 0 <= box["x"] <= width - box["width"]
        if width != PHONE[0]:
            page.keyboard.press("Escape")
    expect(menu.get_by_role("menuitem").first).to_be_focused()
    page.keyboard.press("Escape")
    expect(menu).to_have_count(0)
    expect(row.get_by_role("button", name="Actions")).to_be_focused()
    page.click(f'[data-session-id="{first}"] .tag')
    expect(page.locator("#sessions .session")).to_have_count(1)
    assert page.input_value("#sessions-search") == "wet"
    page.fill("#sessions-search", "")
    expect(page.locator("#sessions .take")).to_have_count(1)
    choose(page, row, "Compare with other")
    expect(page).to_have_url(f"{scripted.url}/sessions/{first}?with={second}")
    other.close()

"""The list of trials on the pages: with a thumb, by keys, and to look at for viewers."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.service.fake_node import Play
from tests.waiting import until
from tests.web.pages import (
    DESK,
    PHONE,
    SMALL_PHONE,
    TOKEN,
    OpenPage,
    at_sizes,
    box_of,
    complaints_at,
    live,
)
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

SIZES = (PHONE, (360, 640), SMALL_PHONE, DESK)


def test_a_thumb_pastes_a_list_records_skips_and_repeats(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 5.0):
        page = live(open_page(scripted.url, 360, 640))
        other = open_page(f"{scripted.url}/nodes")
        expect(page.locator("#trials")).to_be_hidden()
        page.click("#device")
        page.get_by_role("menuitem", name="Trial list …").click()
        assert complaints_at(page, *SIZES) == []
        page.fill("#trials-text", "mud 1; wet\n; deep")
        page.click("#trials-use")
        expect(page.locator("#trials-said")).to_contain_text("line 2")
        page.fill("#trials-text", "mud 1; wet, deep\nmud 2, plate 1")
        page.click("#trials-use")
        expect(page.locator("#trials-rows li")).to_have_count(3)
        expect(page.locator("#trials-said")).to_be_empty()
        assert complaints_at(page, *SIZES) == []
        page.get_by_role("button", name="Close").click()
        for size in at_sizes(page, *SIZES):
            for button in ("record", "skip", "repeat"):
                box = box_of(page.locator(f"#trial-{button}"))
                assert box["height"] >= 44, size
                assert box["x"] + box["width"] <= size[0], size
        page.set_viewport_size({"width": 360, "height": 640})
        expect(other.locator("#trial-name")).to_have_text("mud 1")
        page.click("#trial-record")
        expect(page.locator("#trial-place")).to_have_text("Recording")
        expect(other.locator("#trial-place")).to_have_text("Recording")
        expect(page.locator("#trial-record")).to_be_hidden()
        assert complaints_at(page, *SIZES) == []
        page.click("#stop")
        expect(page.locator("#trial-name")).to_have_text("mud 2")
        page.click("#trial-skip")
        expect(page.locator("#trial-name")).to_have_text("plate 1")
        page.click("#trial-repeat")
        expect(page.locator("#trial-name")).to_have_text("mud 1 (2)")
        other.keyboard.press("n")
        expect(page.locator("#recordings")).to_contain_text("“mud 1 (2)”")
        expect(other.locator("#stop-all")).to_be_enabled()
        other.keyboard.press("s")
        expect(other.locator("#trial-name")).to_have_text("mud 2")
        other.click("#device")
        other.get_by_role("menuitem", name="Trial list …").click()
        first = other.locator("#trials-rows li").first
        expect(first).to_contain_text(re.compile("mud 1 .2.*complete"))
        assert complaints_at(other, PHONE, DESK) == []
    (second, newest) = scripted.running.sessions()[::-1]
    assert [one["name"] for one in (second, newest)] == ["mud 1", "mud 1 (2)"]


def test_an_armed_trial_begins_at_the_contact_and_can_be_disarmed(
    scripted: Scripted, open_page: OpenPage
) -> None:
    scripted.running.http.put(
        "/trials", content=b"mud 1, mud 2", headers={"Content-Type": "text/plain"}
    )
    with Play(scripted.node, 0.0) as play:
        page = live(open_page(scripted.url, *PHONE))
        page.click("#device")
        page.get_by_role("menuitem", name="Trial list …").click()
        page.check("#trials-contact")
        page.fill("#trials-stop", "5000")
        page.press("#trials-stop", "Tab")
        expect(page.locator("#trials-said")).to_contain_text("3600")
        page.fill("#trials-stop", "2")
        page.press("#trials-stop", "Tab")
        expect(page.locator("#trials-said")).to_be_empty()
        page.get_by_role("button", name="Close").click()
        red = "element => getComputedStyle(element).backgroundColor"
        red_rgb = page.locator("#trial-record").evaluate(red)
        page.click("#trial-record")
        expect(page.locator("#trial-place")).to_have_text("Waits for contact")
        assert page.locator("#trial-record").evaluate(red) != red_rgb  # it records nothing
        assert complaints_at(page, *SIZES) == []
        page.click("#trial-record")
        expect(page.locator("#trial-place")).to_have_text("Next, 1 of 2")
        page.click("#trial-record")
        expect(page.locator("#trial-place")).to_have_text("Waits for contact")
        play.force_n = 15.0
        expect(page.locator("#trial-place")).to_have_text(re.compile(r"^Recording, \d s left$"))
        expect(page.locator("#trial-name")).to_have_text("mud 2")  # stopped by the server
        expect(page.locator("#recordings")).to_be_hidden()


def test_a_list_from_a_file_is_read_in_the_encodings_of_spreadsheets(
    scripted: Scripted, open_page: OpenPage, tmp_path: Path
) -> None:
    with Play(scripted.node, 0.0):
        page = live(open_page(scripted.url))
        page.click("#device")
        page.get_by_role("menuitem", name="Trial list …").click()
        for encoding in ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"):
            path = tmp_path / f"{encoding}.txt"
            path.write_text(f"Füße {encoding}\twet", encoding)
            page.set_input_files("#trials-dialog input[type=file]", path)
            expect(page.locator("#trials-text")).to_have_value(f"Füße {encoding}\twet")
        page.click("#trials-use")
        expect(page.locator("#trials-rows li")).to_have_text(re.compile("Füße latin-1.*wet"))


def test_the_dialog_sends_one_setting_and_shows_what_another_page_has_changed(
    scripted: Scripted, open_page: OpenPage
) -> None:
    scripted.running.http.put(
        "/trials", content=b"mud 1, mud 2", headers={"Content-Type": "text/plain"}
    )
    with Play(scripted.node, 0.0):
        page = live(open_page(scripted.url))
        page.click("#device")
        page.get_by_role("menuitem", name="Trial list …").click()
        expect(page.locator("#trials-text")).to_have_value("mud 1\nmud 2\n")
        changes = {"stop_after_s": 300, "node": "bench"}
        assert scripted.running.http.patch("/trials", json=changes).is_success
        expect(page.locator("#trials-stop")).to_have_value("300")
        expect(page.locator("#trials-node")).to_have_value("bench")
        sent: list[object] = []
        page.on(
            "request",
            lambda one: sent.append(one.post_data_json) if one.method == "PATCH" else None,
        )
        page.check("#trials-contact")
        until(lambda: scripted.running.http.get("/trials").json()["start_at_contact"])
        assert sent == [{"start_at_contact": True}]
        page.fill("#trials-text", "mud 3")
        scripted.running.http.post("/trials/record", json={}).raise_for_status()
        expect(page.locator("#trials-text")).to_have_value("mud 3")  # what is being entered stays


def test_a_running_trial_that_is_no_longer_in_the_list_keeps_its_name(
    scripted: Scripted, open_page: OpenPage
) -> None:
    http, headers = scripted.running.http, {"Content-Type": "text/plain"}
    http.put("/trials", content=b"mud 1, mud 2", headers=headers)
    with Play(scripted.node, 5.0):
        page = live(open_page(scripted.url))
        page.click("#trial-record")
        expect(page.locator("#trial-place")).to_have_text("Recording")
        for text in (b"plate 1", b""):
            http.put("/trials", content=text, headers=headers)
            expect(page.locator("#trial-repeat")).to_be_disabled()
            expect(page.locator("#trial-name")).to_have_text("mud 1")
        page.click("#stop")
        expect(page.locator("#trials")).to_be_hidden()


def test_a_viewer_sees_the_list_and_cannot_press(
    script: Callable[..., Scripted], open_page: OpenPage
) -> None:
    scripted = script(token=TOKEN)
    scripted.running.http.put(
        "/trials", content=b"mud 1, mud 2", headers={"Content-Type": "text/plain"}
    )
    with Play(scripted.node, 5.0):
        page = live(open_page(f"{scripted.url}/#ticket={scripted.ticket()}", *PHONE))
        expect(page.locator("#trial-name")).to_have_text("mud 1")
        expect(page.locator("#trial-record")).to_be_hidden()
        page.keyboard.press("n")
        expect(page.locator("#notices")).to_contain_text("viewers cannot record trials")
        page.get_by_role("button", name="Dismiss").click()
        page.click("#device")
        page.get_by_role("menuitem", name="Trial list …").click()
        expect(page.locator("#trials-rows li")).to_have_count(2)
        expect(page.locator("#trials-use")).to_be_hidden()
        assert complaints_at(page, PHONE, DESK) == []

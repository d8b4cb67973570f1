"""The dialog of a node's calibration: seen, chosen, taken back and uploaded."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from service.estimation.calibration import Calibration
from service.sessions.calibration_file import encode_calibration
from tests.builders.calibrations import make_calibration
from tests.service.fake_node import Play
from tests.web.login import log_in
from tests.web.pages import DESK, PHONE, OpenPage, complaints, complaints_at
from tests.web.received import Received
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

JSON = {"Content-Type": "application/json"}


def kept(scripted: Scripted, *serials: str, name: str) -> Calibration:
    calibration = make_calibration(*serials, name=name)
    answer = scripted.running.http.post(
        "/calibrations", content=encode_calibration(calibration), headers=JSON
    )
    assert answer.status_code == 201, answer.text
    return calibration


def used(scripted: Scripted) -> tuple[str, str]:
    said = scripted.running.http.get("/nodes/bench/calibration").json()
    return said["source"], said["calibration"]["name"]


def row(page: Page, calibration: Calibration) -> str:
    return f'#calibrations li[data-id="{calibration.id}"]'


def test_another_calibration_is_chosen_and_the_nodes_own_again(
    scripted: Scripted, open_page: OpenPage
) -> None:
    fits = kept(scripted, "T01", "T02", name="left leg, November")
    lacks = kept(scripted, "T01", name="one tile")
    own = used(scripted)
    with Play(scripted.node, 5.0):
        page = open_page(scripted.url, *PHONE)
        expect(page.locator("#calibration-name")).to_have_text(f"Calibration “{own[1]}”")
        page.click("#calibration")
        expect(page.locator("#calibration-used")).to_contain_text("from the node")
        expect(page.locator("#calibrations li")).to_have_count(2)
        guided = page.locator("#calibration-guided")
        expect(guided).to_have_attribute("href", "/calibrate?node=bench")
        expect(page.locator(row(page, lacks))).to_contain_text("Does not fit: no curve for T02")
        expect(page.locator(f"{row(page, lacks)} button")).to_have_count(0)
        expect(page.locator(row(page, fits))).to_contain_text(f"{fits.date}, T01, T02, scale")
        assert complaints_at(page, DESK, PHONE) == []
        page.click(f"{row(page, fits)} button")
        expect(page.locator(row(page, fits))).to_have_attribute("data-used", "true")
        expect(page.locator("#calibration-used")).to_contain_text("“left leg, November”")
        expect(page.locator("#calibration-used")).to_contain_text("assigned on")
        assert used(scripted) == ("server", "left leg, November")
        assert complaints_at(page, DESK, PHONE) == []
        page.click("#calibration-back")
        expect(page.locator("#calibration-used")).to_contain_text("from the node")
        assert used(scripted) == own
        page.keyboard.press("Escape")
        expect(page.locator("#calibration-dialog")).to_have_count(0)


def test_a_file_is_uploaded_as_it_is_and_what_is_none_is_refused_in_the_servers_words(
    scripted: Scripted, open_page: OpenPage, tmp_path: Path
) -> None:
    calibration = make_calibration("T01", "T02", name="from the bench")
    good, bad = tmp_path / "cal.json", tmp_path / "bad.json"
    good.write_bytes(encode_calibration(calibration))
    bad.write_bytes(encode_calibration(calibration).replace(b"from the bench", b"from the bencH"))
    page = open_page(f"{scripted.url}/nodes")
    page.get_by_role("button", name="Calibration of bench").click()
    expect(page.locator("#calibration-dialog")).to_contain_text("None on the server yet")
    page.set_input_files("#calibration-file", bad)
    expect(page.locator("#calibration-said")).to_contain_text("not a calibration")
    assert complaints(page) == []
    page.set_input_files("#calibration-file", good)
    expect(page.locator(row(page, calibration))).to_contain_text("Covers all tiles")
    expect(page.locator("#calibration-said")).to_be_empty()
    assert scripted.running.http.get(f"/calibrations/{calibration.id}").content == good.read_bytes()


def test_a_choice_that_somebody_else_has_made_meanwhile_is_not_overwritten(
    scripted: Scripted, open_page: OpenPage
) -> None:
    mine = kept(scripted, "T01", "T02", name="mine")
    theirs = kept(scripted, "T01", "T02", name="theirs")
    page = open_page(scripted.url)
    page.click("#calibration")
    expect(page.locator("#calibrations li")).to_have_count(2)
    scripted.running.http.put("/nodes/bench/calibration", json={"id": theirs.id})
    page.click(f"{row(page, mine)} button")
    expect(page.locator("#calibration-said")).to_contain_text(re.compile("Not done: .*bench"))
    assert used(scripted) == ("server", "theirs")


def test_the_dialog_is_loaded_when_it_is_opened(scripted: Scripted, open_page: OpenPage) -> None:
    page = open_page("about:blank")
    log_in(page.context, scripted.url)
    received = Received(page)
    page.goto(scripted.url)
    expect(page.locator("#calibration-name")).to_contain_text("Calibration")
    assert not [url for url in received.bytes_of if url.endswith("/calibration.js")]
    page.click("#calibration")
    expect(page.locator("#calibration-used")).not_to_be_empty()
    received.wait_for("/calibration.js")

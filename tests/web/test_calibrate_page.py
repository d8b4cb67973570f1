"""Page of the guided calibration: from the form to a node that uses the result."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from service.server import weighing, weighings
from tests.service.fake_node import FakeNode, Play
from tests.service.running import Running
from tests.waiting import until
from tests.web.pages import DESK, PHONE, OpenPage, complaints, complaints_at, width_of
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

FORCES_N = (10, 20, 40, 60, 80)
"""A count of the chip is a newton: what the form offers would be too near each other."""


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("REST_S", "HOLD_S"):
        monkeypatch.setattr(weighing, name, 2.5)  # a fit needs steps of 2 s or more


@pytest.mark.slow
def test_a_tile_is_calibrated_and_used_by_its_node(
    server: Running, open_page: OpenPage, quick: None
) -> None:
    node = FakeNode(server, tiles=1)
    node.connect()
    node.tared()
    with Play(node, alive=True) as play:
        page = open_page(f"{server.url}/calibrate", *PHONE)
        expect(page.locator("#tiles input")).to_have_count(1)
        assert complaints(page) == []
        page.check("input[value=sensor]")
        expect(page.locator("#weights")).to_have_value("2 N, 5 N, 10 N, 15 N, 20 N")
        page.fill("#weights", ", ".join(f"{force_n} N" for force_n in FORCES_N))
        page.fill("#within", "0.5")
        page.fill("#name", "left heel")
        page.click("#start")
        steps = page.locator("#steps li li[data-state=done]")
        for count, force_n in enumerate(FORCES_N):
            expect(page.locator("#prompt")).to_have_text(
                f"Press T01 until the sensor reads {force_n} N, and clamp it"
            )
            if not count:
                assert complaints(page) == []
            play.force_n = force_n
            if count == len(FORCES_N) - 1:
                break  # the fit follows at once: the page may never show the last step as done
            expect(steps).to_have_count(count + 1)
            play.force_n = 0.0
            if not count:
                expect(page.locator("#repeat")).to_have_text(f"Repeat {force_n} N")
                page.reload()  # the server holds the state
                expect(steps).to_have_count(1)
            if count == len(FORCES_N) - 2:
                assert width_of(page) <= PHONE[0]
        expect(page.locator("#result-title")).to_have_text("left heel")
        expect(page.locator("#about")).to_contain_text("force sensor, 5 weights within ±0.5 %")
        expect(page.locator("#result tbody tr")).to_have_count(len(FORCES_N))
        for heading in ("Noise", "Settled"):
            expect(page.get_by_role("columnheader", name=heading)).to_be_in_viewport(ratio=1)
        expect(page.locator("#result svg.curve circle")).to_have_count(len(FORCES_N))
        assert complaints(page) == []
        page.click("#accept")
        expect(page.locator("#notices")).to_contain_text(
            "bench uses this calibration from the next frame"
        )
        expect(page.locator("#setup")).to_be_visible()
        used = server.http.get("/nodes/bench/calibration").json()
        assert (used["source"], used["calibration"]["name"]) == ("server", "left heel")
    node.close()


def test_a_failed_calibration_shows_its_reason_and_can_be_repeated(
    scripted: Scripted, open_page: OpenPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Play(scripted.node, 5.0, alive=True):
        page = open_page(f"{scripted.url}/calibrate?node=bench", *PHONE)
        for field in ("#reference", "#name"):
            expect(page.locator(field)).to_have_attribute(
                "placeholder", re.compile("^for example ")
            )
        page.uncheck("#tiles input[value=T01]")
        page.check("#tiles input[value=T01]")  # now it is the second one
        page.fill("#weights", "200 g, 500 g, 1 kg, 2 kg")
        page.click("#start")
        expect(page.locator("#notices")).to_contain_text("4 weights on the tile")
        page.fill("#weights", "200 g, 500 g, 1 kg, 1.5 kg, 2.2 kg")
        page.fill("#within", "2.5")
        monkeypatch.setattr(weighings, "IDLE_S", 5.0)
        page.click("#start")
        expect(page.locator("#progress")).to_have_text("T02, weight 1 of 5, tile 1 of 2")
        expect(page.locator("#problem")).to_contain_text("no step was completed")
        expect(page.locator("#accept")).to_be_hidden()
        assert complaints_at(page, DESK, PHONE) == []
        page.click("#restart")
        expect(page.locator("#guide")).to_be_visible()
        page.reload()
        expect(page.locator("#problem")).to_contain_text("no step was completed")
        page.click("#save")
        expect(page.locator("#setup")).to_be_visible()
        expect(page.locator("[data-order=T02]")).to_have_text("1.")
        expect(page.locator("#weights")).to_have_value("200 g, 500 g, 1 kg, 1.5 kg, 2.2 kg")
        expect(page.locator("#within")).to_have_value("2.5")
        until(lambda: not scripted.running.node()["recording"])

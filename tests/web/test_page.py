"""The live page while its server is away, and with tiles that have no value."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from playwright.sync_api import expect

from devices.flags import TileFlag
from devices.frames import NOT_READ, FrameBatch
from tests.service.fake_node import FakeNode, Play
from tests.waiting import until
from tests.web.pages import OpenPage, box_of, live
from tests.web.scripted import Scripted

pytestmark = pytest.mark.real_time


def test_a_stopped_server_greys_the_page_within_a_second_and_it_comes_back(
    scripted: Scripted, open_page: OpenPage
) -> None:
    running, node = scripted.running, scripted.node
    with Play(node):
        page = live(open_page(scripted.url))
        body = page.locator("body")
        page.keyboard.press("r")
        expect(page.locator("#stop")).to_be_enabled()
    stopped_s = time.monotonic()
    running.stop()
    expect(body).to_have_attribute("data-live", "false")
    assert time.monotonic() - stopped_s < 1.5  # a second, and what looking takes
    expect(page.locator("#frozen")).to_contain_text("No data")
    running.start()
    node.connect()
    node.next_t_mono_ns = time.monotonic_ns()
    with Play(node):
        expect(body).to_have_attribute("data-live", "true")
        # What was recorded when the server was stopped goes on, without a gap.
        expect(page.locator("#stop")).to_be_enabled()
        page.keyboard.press("s")
        until(lambda: running.sessions()[0]["state"] == "sealed", every_s=0.05)
    assert running.sessions()[0]["complete"] is True


class Silent(FakeNode):
    """A node whose second tile does not answer, once it is silent."""

    is_silent = False

    def frames(self, n: int, *arguments: Any, **how: Any) -> FrameBatch:
        batch = super().frames(n, *arguments, **how)
        if not self.is_silent:
            return batch
        pressure_raw, tile_flags = batch.pressure_raw.copy(), batch.tile_flags.copy()
        pressure_raw[:, 1], tile_flags[:, 1] = NOT_READ, TileFlag.NO_ANSWER
        self.sent[-1] = replace(batch, pressure_raw=pressure_raw, tile_flags=tile_flags)
        return self.sent[-1]


def test_saturated_and_silent_tiles_cannot_be_mistaken_for_values(
    script: Callable[..., Scripted], open_page: OpenPage
) -> None:
    server = script()
    server.node.close()
    node = Silent(server.running, "silent", tiles=4)
    node.connect()
    node.tared()
    node.is_silent = True
    with Play(node, (5.0, 5.0, 200.0, 5.0)):
        page = open_page(server.url)
        page.select_option("#node-select", "silent")
        for serial, state, said in (
            ("T02", "no_answer", "no answer"),
            ("T03", "saturated", "saturated"),
        ):
            bar = page.locator(f'#bars [data-serial="{serial}"]')
            expect(bar).to_have_attribute("data-state", state)
            expect(bar).to_have_attribute("data-value", "")
            expect(bar).to_contain_text(said)
        expect(page.locator("#grf")).to_have_attribute("data-value", "")  # no sum without T02
        # What T01, T03 and T04 bear at least, and why it is no more.
        expect(page.locator("#grf-bound")).to_have_text("at least")
        # Not `inner_text`: a pause of the frames hides the card, as on a busy machine.
        at_least_n = float(page.text_content("#grf") or "nan")
        assert 20.0 < at_least_n < 210.0
        expect(page.locator("#grf-sigma")).to_have_text("(T02 missing, T03 saturated)")
        expect(page.locator("#cop")).to_have_text("No COP: T02 missing, T03 saturated")
        for serial in ("T01", "T04"):  # the others go on
            expect(page.locator(f'#bars [data-serial="{serial}"]')).to_have_attribute(
                "data-state", "ok"
            )
        expect(page.locator("#contact")).to_have_attribute("data-contact", "true")
        expect(page.locator("#trace-bound-legend")).to_be_visible()
        card, contact = (box_of(page.locator(name)) for name in ("#grf-card", "#contact"))
        assert contact["x"] + contact["width"] <= card["x"] + card["width"]
    node.close()

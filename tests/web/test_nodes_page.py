"""The page of all nodes: a card for each, and record, marker and stop for all."""

from __future__ import annotations

import json
import re

import pytest
from playwright.sync_api import Route, expect

from devices.vitals import Vitals
from service.protocol.link import compute_fingerprint
from tests.service.fake_node import FakeNode, Play
from tests.service.running import closed
from tests.waiting import until
from tests.web.pages import DESK, PHONE, OpenPage, blue_px, complaints, complaints_at
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


def card(node: str) -> str:
    return f'.node[data-node="{node}"]'


def live(node: str) -> str:
    return f'.node[data-node="{node}"][data-live="true"]'


def test_two_feet_are_recorded_marked_and_stopped_together_and_one_is_lost_in_between(
    scripted: Scripted, open_page: OpenPage
) -> None:
    right = FakeNode(scripted.running, "right")
    right.connect()
    right.tared()
    http = scripted.running.http
    with Play(scripted.node, 5.0):
        page = open_page(scripted.url)
        page.click("#all-nodes")
        with Play(right, 5.0):
            for name in ("bench", "right"):
                expect(page.locator(f"{live(name)} .value")).to_have_attribute(
                    "data-value", re.compile(".")
                )
            page.fill("#take-name", "both feet")
            page.press("#take-name", "Enter")
            expect(page.locator('.node[data-recording="true"]')).to_have_count(2)
            expect(page.locator("#take-running")).to_contain_text("“both feet” on 2 nodes")
            expect(page.locator("#take-losses")).to_have_text("0 lost, 0 not sampled")
            late = {"type": "status", "missed_slots": 2000, "warnings": []}
            right.socket.send(json.dumps(late))
            expect(page.locator("#take-losses")).to_have_text(
                re.compile(r"^0 lost, 2,000 not sampled \(up to \d+\u00a0%\)$")
            )
            expect(page.locator("#take-losses")).to_have_attribute("data-bad", "true")
            page.fill("#take-label", "a stone")
            page.press("#take-label", "Enter")
            expect(page.locator("#notices")).to_contain_text("Marker “a stone” set on 2 nodes")
        right.leave()
        expect(page.locator(f"{card('right')} .state")).to_have_text("offline")
        page.fill("#take-label", "one is lost")
        page.press("#take-label", "Enter")
        expect(page.locator("#notices")).to_contain_text("Marker “one is lost” set on 2 nodes")
        page.keyboard.press("s")
        expect(page.locator("#take-text")).to_be_hidden()
        expect(page.locator(f"{card('bench')} .node-session")).to_contain_text("complete")
        expect(page.locator(f"{card('right')} .node-session")).to_contain_text("pending")
    bench, other = sorted(scripted.running.sessions(), key=lambda session: str(session["node"]))
    assert (bench["node"], other["node"]) == ("bench", "right")
    assert bench["name"] == other["name"] == "both feet"
    assert bench["take"] == other["take"] is not None
    markers = [http.get(f"/sessions/{one['id']}/markers").json()["items"] for one in (bench, other)]
    assert markers[0] == markers[1]
    assert [marker["label"] for marker in markers[0]] == ["a stone", "one is lost"]
    right.close()


def test_a_node_that_sends_nothing_is_not_recorded_and_its_card_says_why(
    scripted: Scripted, open_page: OpenPage
) -> None:
    silent = FakeNode(scripted.running, "silent")
    try:
        silent.connect()
        with Play(scripted.node, 5.0):
            page = open_page(f"{scripted.url}/nodes", *PHONE)
            expect(page.locator(live("bench"))).to_have_count(1)
            expect(page.locator(f"{card('silent')} .state")).to_have_text("no data yet")
            assert complaints_at(page, DESK, PHONE) == []
            page.keyboard.press("?")
            expect(page.locator("#help-dialog")).to_contain_text("Record all connected nodes")
            assert complaints_at(page, DESK, PHONE) == []
            page.keyboard.press("Escape")
            expect(page.locator("#help-dialog")).to_be_hidden()
            expect(page.locator("#record-all")).to_be_enabled()  # axe has held it up
            page.keyboard.press("r")
            expect(page.locator(f"{card('bench')}[data-recording=true]")).to_have_count(1)
            refused = page.locator(f"{card('silent')} .refused")
            expect(refused).to_contain_text("Not recorded: node 'silent' sends no frames")
            expect(page.locator("#notices")).to_contain_text("silent not recorded")
            expect(page.locator("#stop-all")).to_be_enabled()
            assert complaints_at(page, DESK, PHONE) == []
            page.keyboard.press("r")
            expect(page.locator("#notices")).to_contain_text("stop the running recording first")
            page.keyboard.press("s")
            expect(page.locator("#take-text")).to_be_hidden()
            assert len(scripted.running.sessions()) == 1
    finally:
        silent.close()


def test_tare_all_tares_who_can_be_tared_says_who_cannot_and_can_be_undone(
    scripted: Scripted, open_page: OpenPage
) -> None:
    loaded = FakeNode(scripted.running, "loaded")
    loaded.connect()
    http = scripted.running.http

    def tares(node: str) -> list[bool]:
        return [tare["undone"] for tare in http.get(f"/nodes/{node}/tares").json()["items"]]

    before = tares("bench")
    try:
        with Play(scripted.node, alive=True), Play(loaded, 20.0):
            page = open_page(f"{scripted.url}/nodes")
            for name in ("bench", "loaded"):
                expect(page.locator(live(name))).to_have_count(1)
            page.wait_for_timeout(3000)  # frames to tare from
            held: list[Route] = []
            # The lambda is needed: Playwright sets an attribute of it.
            page.route("**/tare", lambda route: held.append(route))  # noqa: PLW0108  # playwright counts parameters
            page.keyboard.press("t")
            expect(page.locator("#notices")).to_have_text(re.compile("^Taring 2 nodes"))
            while len(held) < 2:
                page.wait_for_timeout(50)
            for route in held:
                route.continue_()
            expect(page.locator("#notices")).to_contain_text("1 node tared")
            expect(page.locator("#notices")).not_to_contain_text("Taring")
            tared = page.locator(f"{card('bench')} .node-facts div", has_text="Tare")
            expect(tared).to_have_text(re.compile(r"^Tare\d{4}-\d\d-\d\d \d\d:\d\d:\d\d$"))
            expect(page.locator(f"{card('loaded')} .refused")).to_contain_text("Not tared: ")
            expect(page.locator(f"{card('bench')} .refused")).to_have_count(0)
            assert tares("bench") == [False, *before]
            page.locator("#notices").get_by_role("button", name="Undo").click()
            expect(page.locator("#notices")).to_contain_text("Tare undone on 1 node")
            assert tares("bench") == [True, *before]
    finally:
        loaded.close()


COLOURS = """async () => {
  const { SmallFoot } = await import("/static/nodes/small_foot.js");
  const canvas = document.querySelector(".node-foot").cloneNode();
  document.querySelector(".node").append(canvas);
  const foot = new SmallFoot(canvas);
  const tiles = [0, 1, 2, 3].map((i) => (
    { serial: `T${i}`, x_m: 0.014 * i, y_m: 0, z_m: -0.15, full_scale_n: 29 }));
  const node = { node: "n", tiles, tare: {}, calibration: {}, servo: null };
  foot.draw(node, { tile_flags: [0, 0, 0, 0], force_n: [0, 10, 17, 21], saturated: [] });
  const ratio = canvas.width / canvas.clientWidth;
  const copy = new OffscreenCanvas(canvas.width, canvas.height)
    .getContext("2d", { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0);
  const light = foot.layout.points.map(({ x, y }) => {
    const at = [(x + 0.7 * foot.layout.radiusPx) * ratio, y * ratio, 1, 1];
    const [r, g, b] = copy.getImageData(...at).data;
    return (0.2126 * r + 0.7152 * g + 0.0722 * b) / 255;
  });
  canvas.remove();
  return { light, top: foot.range.ofFoot("N") };
}"""
"""How light tiles of 0, 10, 17 and 21 N are on a card."""


def test_tiles_of_17_and_21_n_differ_from_each_other_and_are_far_from_white(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 5.0):
        page = open_page(f"{scripted.url}/nodes")
        expect(page.locator(live("bench"))).to_have_count(1)
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            found = page.evaluate(COLOURS)
            none, *loaded = found["light"]
            assert found["top"] == 29
            assert all(0.04 < light < 0.85 for light in loaded[1:]), scheme
            steps = [abs(a - b) for a, b in zip(found["light"], loaded, strict=False)]
            assert min(steps) > 0.02, scheme
            assert abs(loaded[-1] - none) > 0.3, scheme


def test_a_card_has_the_trace_contact_and_warnings_of_its_node(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0) as play:
        page = open_page(f"{scripted.url}/nodes")
        bench = page.locator(card("bench"))
        expect(bench.locator(".contact")).to_have_attribute("data-contact", "true")
        expect(bench.locator(".contact")).to_have_text("contact")
        until(lambda: blue_px(page, ".node-trace", 0.5, 1.0) > 50)
        scripted.tell("tile S0 (mux 0x70 channel 0) does not answer")
        expect(bench.locator(".node-notes")).to_contain_text("Tile S0 (mux 0x70 channel 0)")
        play.force_n = 0.0
        expect(bench.locator(".contact")).to_have_text("flight")
        assert complaints(page) == []


def test_a_card_has_the_vitals_of_its_nodes_machine(
    scripted: Scripted, open_page: OpenPage
) -> None:
    vitals = Vitals(cpu_celsius=54.3, recording_left_s=40_000.0, wifi_dbm=-61.0)
    with Play(scripted.node, 15.0):
        page = open_page(f"{scripted.url}/nodes")
        bench = page.locator(card("bench"))
        expect(page.locator(live("bench"))).to_have_count(1)
        expect(bench.get_by_text("Machine")).to_be_hidden()
        scripted.tell("the supply sags: use a 5 V 3 A supply and a short cable", vitals=vitals)
        expect(bench.locator(".node-facts")).to_contain_text("54 °C, disk for 11 h, Wi-Fi -61 dBm")
        expect(bench.get_by_text("Machine")).to_be_visible()
        expect(bench.locator(".node-notes")).to_contain_text("use a 5 V 3 A supply")
        assert complaints(page) == []


def test_the_page_says_that_a_node_or_the_server_is_away_and_goes_on_by_itself(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 5.0):
        page = open_page(f"{scripted.url}/nodes")
        expect(page.locator(live("bench"))).to_have_count(1)
    expect(page.locator(f"{card('bench')} .state")).to_contain_text("no data for")
    scripted.node.leave()
    expect(page.locator(f"{card('bench')} .state")).to_have_text("offline")
    expect(page.locator("#record-all")).to_be_disabled()
    expect(page.locator("#take-why")).to_contain_text("no node is connected")
    assert complaints(page) == []
    scripted.running.stop()
    expect(page.locator("#link-down")).to_be_visible()
    scripted.running.start()
    scripted.node.come_back()
    expect(page.locator("#link-down")).to_be_hidden()
    with Play(scripted.node, 5.0):
        expect(page.locator(live("bench"))).to_have_count(1)


@pytest.mark.parametrize("address", ["/nodes", "/"])
def test_another_machine_that_asks_for_a_name_is_accepted_with_a_button(
    scripted: Scripted, open_page: OpenPage, address: str
) -> None:
    stranger = FakeNode(scripted.running, scripted.node.name)
    assert stranger.secret is not None
    fingerprint = compute_fingerprint(stranger.secret)

    def ask() -> int:
        stranger.prove(secret=stranger.secret, proof=None)
        stranger.socket.send(stranger.hello().model_dump_json())
        return closed(stranger.socket)[0]

    try:
        with Play(scripted.node, 5.0):
            page = open_page(
                f"{scripted.url}{address}",
            )
            warning = page.locator(".replacement")
            expect(warning).to_be_hidden()
            assert ask() == 4013
            expect(warning).to_contain_text(f"{fingerprint} from 127.0.0.1")
            assert complaints(page) == []
            warning.locator("button").click()
            expect(page.locator("#ask-text")).to_contain_text("is disconnected and refused")
            page.click("#ask-yes")
            expect(warning).to_be_hidden()
            expect(page.locator("#notices")).to_contain_text(f"{fingerprint} is now bench")
        stranger.connect()
    finally:
        stranger.close()

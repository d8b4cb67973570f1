"""The page of all nodes: a card for each, and all recorded, marked and stopped with one press."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from service.identity import fingerprint_of
from tests.service.fake_node import FakeNode, Play
from tests.service.running import closed
from tests.waiting import until
from tests.web.conftest import Field, wait_until
from tests.web.scripted import Scripted
from tests.web.test_accessible import SIZES, complaints
from tests.web.test_page import PRESSED_N, load_file, scene_file

pytestmark = pytest.mark.real_time

OpenPage = Callable[..., Page]
TOKEN = "a-token-of-this-test"  # noqa: S105  # of this test


@pytest.fixture
def two(tmp_path: Path, field_environment: dict[str, str]) -> Iterator[Field]:
    """Two feet of four emulated tiles under a load; slow ones, as a busy machine can take."""
    field = Field(tmp_path, field_environment)
    field.serve()
    scene, load = scene_file(tmp_path), load_file(tmp_path, PRESSED_N)
    of_paper = 'calibration = "paper-eq2-shape"\nrate_hz = 100\n'
    scene.write_text(of_paper + scene.read_text())
    for name in ("left", "right"):
        options = ("--load", str(load), "--lead-s=2", "--journal", str(tmp_path / name))
        field.start_node(str(scene), *options, "--name", name)
    try:
        yield field
    finally:
        field.close()


def card(node: str) -> str:
    return f'.node[data-node="{node}"]'


def live(node: str) -> str:
    return f'.node[data-node="{node}"][data-live="true"]'


def test_two_feet_are_recorded_marked_and_stopped_together_and_one_is_lost_in_between(
    two: Field, open_page: OpenPage
) -> None:
    wait_until(
        lambda: sum(bool(node["tare"]) for node in two.get("/nodes")["items"]) == 2, "two tares", 90
    )
    page = open_page(two.url)
    page.click("#all-nodes")
    for name in ("left", "right"):
        expect(page.locator(live(name))).to_have_count(1)
        expect(page.locator(f"{live(name)} .value")).to_have_attribute(
            "data-value", re.compile(".")
        )
    page.fill("#take-name", "both feet")
    page.press("#take-name", "Enter")
    expect(page.locator('.node[data-recording="true"]')).to_have_count(2)
    expect(page.locator("#take-running")).to_contain_text("“both feet” on 2 nodes")
    page.fill("#take-label", "a stone")
    page.press("#take-label", "Enter")
    expect(page.locator("#notices")).to_contain_text("Marked “a stone” on 2 nodes")

    two.others[1].kill()  # the right one
    expect(page.locator(f"{card('right')} .state")).to_have_text("away")
    page.fill("#take-label", "one is lost")
    page.press("#take-label", "Enter")
    expect(page.locator("#notices")).to_contain_text("Marked “one is lost” on 2 nodes")
    page.keyboard.press("s")
    expect(page.locator("#take-text")).to_be_hidden()
    expect(page.locator(f"{card('left')} .node-session")).to_contain_text("complete")
    expect(page.locator(f"{card('right')} .node-session")).to_contain_text("pending")

    left, right = sorted(two.get("/sessions")["items"], key=lambda session: str(session["node"]))
    assert (left["node"], right["node"]) == ("left", "right")
    assert left["name"] == right["name"] == "both feet"
    assert left["take"] == right["take"] is not None
    marks = [two.get(f"/sessions/{session['id']}/events")["items"] for session in (left, right)]
    assert marks[0] == marks[1]
    assert [mark["label"] for mark in marks[0]] == ["a stone", "one is lost"]


@SIZES
def test_a_node_that_sends_nothing_is_not_recorded_and_its_card_says_why(
    scripted: Scripted, open_page: OpenPage, size: tuple[int, int]
) -> None:
    silent = FakeNode(scripted.running, "silent")
    try:
        silent.connect()
        with Play(scripted.node, 5.0):
            page = open_page(f"{scripted.url}/nodes", *size)
            expect(page.locator(live("bench"))).to_have_count(1)
            expect(page.locator(f"{card('silent')} .state")).to_have_text("no data yet")
            assert complaints(page) == []
            page.keyboard.press("?")
            expect(page.locator("#help-dialog")).to_contain_text("Record all that are connected")
            assert complaints(page) == []
            page.keyboard.press("Escape")
            expect(page.locator("#help-dialog")).to_be_hidden()
            expect(page.locator("#record-all")).to_be_enabled()  # axe has held it up
            page.keyboard.press("r")
            expect(page.locator(f"{card('bench')}[data-recording=true]")).to_have_count(1)
            refused = page.locator(f"{card('silent')} .refused")
            expect(refused).to_contain_text("Not recorded: node 'silent' is not sending")
            expect(page.locator("#notices")).to_contain_text("silent is not recorded")
            expect(page.locator("#stop-all")).to_be_enabled()
            assert complaints(page) == []
            assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
            page.keyboard.press("r")
            expect(page.locator("#notices")).to_contain_text("Stop what is being recorded first")
            page.keyboard.press("s")
            expect(page.locator("#take-text")).to_be_hidden()
            assert len(scripted.running.sessions()) == 1
    finally:
        silent.close()


def test_the_page_says_that_a_node_or_the_server_is_away_and_goes_on_by_itself(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 5.0):
        page = open_page(f"{scripted.url}/nodes")
        expect(page.locator(live("bench"))).to_have_count(1)
    expect(page.locator(f"{card('bench')} .state")).to_contain_text("no data for")
    scripted.node.leave()
    expect(page.locator(f"{card('bench')} .state")).to_have_text("away")
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


def test_a_viewer_sees_all_nodes_and_is_offered_no_button(
    script: Callable[..., Scripted], open_page: OpenPage
) -> None:
    server = script(token=TOKEN)
    ticket = server.running.http.post("/tickets", json={"may": "look"}).json()["ticket"]
    with Play(server.node):
        page = open_page(f"{server.url}/nodes#ticket={ticket}")
        expect(page.locator(live("bench"))).to_have_count(1)
        expect(page.locator("#login")).to_have_text("viewer: looks only")
        expect(page.locator("#record-all")).to_be_hidden()
        page.keyboard.press("r")
        expect(page.locator("#notices")).to_contain_text("may look, and not press")
        assert complaints(page) == []
        server.running.http.post("/takes", json={"name": "by another one"})
        expect(page.locator("#take-running")).to_contain_text("“by another one” on 1 node")
        until(lambda: len(server.running.sessions()) == 1)


@pytest.mark.parametrize("address", ["/nodes", "/"])
def test_another_machine_that_asks_for_a_name_is_accepted_with_a_button(
    scripted: Scripted, open_page: OpenPage, address: str
) -> None:
    stranger = FakeNode(scripted.running, scripted.node.name)
    assert stranger.secret is not None
    fingerprint = fingerprint_of(stranger.secret)

    def ask() -> int:
        stranger.prove(secret=stranger.secret, proof=None)
        stranger.socket.send(stranger.hello().model_dump_json())
        return closed(stranger.socket)[0]

    try:
        with Play(scripted.node, 5.0):
            page = open_page(f"{scripted.url}{address}", *SIZES.args[1][0])
            warning = page.locator(".replacement")
            expect(warning).to_be_hidden()
            assert ask() == 4013
            expect(warning).to_contain_text(f"{fingerprint}, from 127.0.0.1")
            assert complaints(page) == []
            warning.locator("button").click()
            expect(page.locator("#ask-text")).to_contain_text("is disconnected and refused")
            page.click("#ask-yes")
            expect(warning).to_be_hidden()
            expect(page.locator("#notices")).to_contain_text(f"{fingerprint} is bench")
        stranger.connect()
    finally:
        stranger.close()

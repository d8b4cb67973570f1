"""A viewer sees every page, and is offered nothing to press that the server would refuse."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Page, expect

from service.sessions.calibration_file import encode_calibration
from tests.builders.calibrations import make_calibration
from tests.service.fake_node import Play
from tests.waiting import until
from tests.web.pages import PHONE, TOKEN, OpenPage, complaints, live
from tests.web.scripted import Scripted
from tests.web.session_page import drag_in_plots, left_px, settled, with_marker
from tests.web.session_rows import open_menu

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


@pytest.fixture
def server(script: Callable[..., Scripted]) -> Scripted:
    """A server that asks for a login."""
    return script(token=TOKEN)


def as_viewer(server: Scripted, open_page: OpenPage, path: str, *size: int) -> Page:
    page = open_page(f"{server.url}{path}#ticket={server.ticket()}", *size)
    expect(page.locator("#login")).to_have_text("viewer (read-only)")
    return page


def test_a_viewer_is_offered_nothing_and_the_server_refuses_it(
    server: Scripted, open_page: OpenPage
) -> None:
    with Play(server.node):
        server.node.record(name="by another one")
        page = live(as_viewer(server, open_page, "/", *PHONE))
        expect(page.locator("#recordings li")).to_have_count(1)
        for gone in ("#tare", "#record", "#stop", "#marker", "#session-name", "#marker-label"):
            expect(page.locator(gone)).to_be_hidden()
        assert complaints(page) == []
        page.click("#calibration")
        expect(page.locator("#calibration-used")).to_contain_text("from the node")
        page.keyboard.press("Escape")
        expect(page.locator("#calibration-dialog")).to_have_count(0)
        page.keyboard.press("s")
        expect(page.locator("#notices")).to_contain_text("viewers cannot tare")
        page.click("#to-sessions")
        menu = open_menu(page, page.locator("#sessions .session"))
        expect(menu.get_by_role("menuitem", name="Download CSV")).to_be_visible()
        for gone in ("Edit", "Delete", "Seal"):
            expect(menu.get_by_role("menuitem", name=gone)).to_have_count(0)
        status = page.evaluate(
            """fetch('/api/v1/sessions', {method: 'POST', body: '{"node": "bench", "name": "x"}',
                headers: {'Content-Type': 'application/json'}}).then((answer) => answer.status)"""
        )
        assert status == 403
        assert [one["name"] for one in server.running.sessions()] == ["by another one"]
        link = f"{server.url}/#ticket={server.ticket('operator')}"
        with page.expect_navigation():
            page.evaluate("(url) => { location.href = url; }", link)  # in the same tab
        expect(page.locator("#stop")).to_be_visible()
        expect(page.locator("#login")).to_be_hidden()


def test_a_viewer_sees_all_nodes_and_their_calibrations_without_a_button(
    server: Scripted, open_page: OpenPage
) -> None:
    calibration = make_calibration("T01", "T02", name="left leg")
    kept = server.running.http.post(
        "/calibrations",
        content=encode_calibration(calibration),
        headers={"Content-Type": "application/json"},
    )
    assert kept.status_code == 201
    with Play(server.node):
        page = as_viewer(server, open_page, "/nodes")
        expect(page.locator('.node[data-node="bench"][data-live="true"]')).to_have_count(1)
        expect(page.locator("#record-all")).to_be_hidden()
        page.keyboard.press("r")
        expect(page.locator("#notices")).to_contain_text("viewers cannot tare")
        assert complaints(page) == []
        server.running.http.post("/takes", json={"name": "by another one"})
        expect(page.locator("#take-running")).to_contain_text("“by another one” on 1 node")
        until(lambda: len(server.running.sessions()) == 1)
        page.get_by_role("button", name="Calibration of bench").click()
        row = f'#calibrations li[data-id="{calibration.id}"]'
        expect(page.locator(row)).to_be_visible()
        for button in (f"{row} button", "#calibration-file", "#calibration-back"):
            expect(page.locator(button)).to_be_hidden()


def test_a_viewer_sees_a_guided_calibration_and_cannot_change_it(
    server: Scripted, open_page: OpenPage
) -> None:
    plan = {"tiles": ["T01"], "weights": ["10 N", "20 N", "30 N", "40 N", "50 N"]}
    with Play(server.node, alive=True):
        page = as_viewer(server, open_page, "/calibrate")
        expect(page.locator("#setup-viewer")).to_be_visible()
        expect(page.locator("#start")).to_be_hidden()
        server.running.http.post("/nodes/bench/weighing", json=plan)
        expect(page.locator("#prompt")).to_contain_text("T01")
        for button in ("#repeat", "#cancel"):
            expect(page.locator(button)).to_be_hidden()
        server.running.http.delete("/nodes/bench/weighing")
        expect(page.locator("#setup")).to_be_visible()


def test_a_viewer_drags_no_marker_and_is_offered_to_change_none(
    server: Scripted, open_page: OpenPage
) -> None:
    session = with_marker(server)
    page = as_viewer(server, open_page, f"/sessions/{session.id}")
    settled(page)
    expect(page.get_by_label("Edit marker a stone")).to_be_hidden()
    expect(page.locator("#edit")).to_be_hidden()
    before_s = page.locator("#markers-list li").get_attribute("data-time-s")
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.method))
    middle = (left_px(page) + page.locator("#plots").evaluate("(plots) => plots.clientWidth")) / 2
    drag_in_plots(page, middle + 12, middle + 160)
    expect(page.locator("#plots")).to_have_attribute("data-whole", "false")  # a stretch is chosen
    expect(page.locator("#markers-list li")).to_have_attribute("data-time-s", before_s or "")
    assert set(asked) <= {"GET"}

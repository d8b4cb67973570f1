"""What a page says of itself: too old a browser, scripts that fail, errors, no answer."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial

import pytest
from playwright.sync_api import Route, expect

from tests.service.fake_node import Play
from tests.service.running import Running
from tests.waiting import until
from tests.web.pages import DESK, LIVE, PHONE, TOKEN, OpenPage, complaints, complaints_at, live
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

Answer = Callable[[Route], object]
PAGES = ("/", "/nodes", "/calibrate", "/clock", "/docs", "/sessions", "/sessions/none")


@pytest.fixture
def open_faulty(open_page: OpenPage) -> OpenPage:
    """Opens a page that may complain."""
    return partial(open_page, may_complain=True)


def script_answer(text: str) -> Answer:
    return lambda route: route.fulfill(body=text, content_type="text/javascript")


@pytest.mark.parametrize(
    ("path", "answer", "said"),
    [
        ("/", script_answer("const = broken"), r"SyntaxError: .*\(/static/common/text\.js:1:7\)"),
        ("/", script_answer("export const older = 1;"), "does not provide an export named"),
        *((path, lambda route: route.abort(), "did not load: http") for path in PAGES),
    ],
    ids=["syntax", "older", *(f"absent {path}" for path in PAGES)],
)
def test_a_page_whose_scripts_fail_says_so_and_what_to_report(
    server: Running, open_faulty: OpenPage, path: str, answer: Answer, said: str
) -> None:
    page = open_faulty(f"{server.url}{path}?secret=1", answers={"**/common/text.js": answer})
    guard = page.locator("#guard")
    expect(guard.locator("h2")).to_have_text(re.compile("could not start|Error on this page"))
    report = guard.locator("pre")
    for part in (said, "Chrome/"):
        expect(report).to_contain_text(re.compile(part))
    expect(report).not_to_contain_text("secret")


def test_a_browser_that_is_too_old_is_told_which_ones_are_not(
    server: Running, open_faulty: OpenPage
) -> None:
    page = open_faulty(server.url, first="delete Array.prototype.findLast")
    expect(page.locator("#guard h2")).to_have_text("This browser is too old for this page")
    expect(page.locator("#guard p").first).to_contain_text("Firefox 115")
    assert complaints(page) == []


COVERED = """() => {
  const box = document.getElementById("guard").getBoundingClientRect();
  const apart = (rect) => rect.bottom <= box.top || rect.top >= box.bottom;
  const all = [...document.querySelectorAll("header *, #live *, #actions *")];
  const area = ({ width, height }) => width * height;  // an empty box covers nothing
  const isSeen = (e) => e instanceof HTMLElement && area(e.getBoundingClientRect()) > 1;
  const seen = all.filter(isSeen);
  return seen.filter((e) => !apart(e.getBoundingClientRect())).map((e) => e.outerHTML);
}"""
"""What the report lies over."""


def test_an_error_is_told_once_and_covers_no_control(
    scripted: Scripted, open_faulty: OpenPage
) -> None:
    with Play(scripted.node, 5.0):
        page = live(open_faulty(scripted.url, *PHONE))
        guard = page.locator("#guard")
        page.evaluate("setTimeout(() => { throw new Error('ResizeObserver loop limit'); })")
        page.evaluate("void Promise.reject(new DOMException('taken back', 'AbortError'))")
        expect(guard.locator("pre")).to_contain_text("ResizeObserver loop limit")
        page.evaluate(
            "for (let i = 0; i < 40; i++) setTimeout(() => { throw new Error(`no. ${i}`) })"
        )
        expect(guard.locator("pre")).to_contain_text("… and 36 more")
        page.evaluate("void Promise.reject(new TypeError('a promise'))")
        expect(guard.locator("pre")).to_contain_text("… and 37 more")
        expect(guard).not_to_contain_text("taken back")
        for size in (DESK, PHONE):
            assert complaints_at(page, size) == []
            assert page.evaluate(COVERED) == []
        page.click("#guard button:has-text('Dismiss')")
        expect(guard).to_be_hidden()
        page.evaluate("setTimeout(() => { throw new Error('one more') })")
        page.click("#record")  # the page goes on
        expect(page.locator("#recordings li")).to_have_count(1)
        expect(guard).to_be_hidden()


def test_each_way_to_fail_has_its_own_words(scripted: Scripted, open_faulty: OpenPage) -> None:
    login = "<h1>Log in</h1>"
    answers: dict[str, Answer] = {
        "cannot be reached": lambda route: route.abort(),
        "not from a FootTile server": lambda route: route.fulfill(
            body=login, content_type="text/html"
        ),
        "refused: 502": lambda route: route.fulfill(status=502, body="<h1>Bad</h1>"),
        "It rests.": lambda route: route.fulfill(status=409, json={"detail": "It rests."}),
    }
    with Play(scripted.node, 5.0):
        page = open_faulty(scripted.url)
        for said, answer in answers.items():
            page.route("**/tare", answer)
            page.click("#tare")
            expect(page.locator("#notices")).to_contain_text(said)
            page.unroute("**/tare")
        expect(page.locator("#guard")).to_have_count(0)


@pytest.mark.parametrize(
    ("path", "where"), [("/", "#frozen-reason"), ("/nodes", "#link-down")], ids=["live", "nodes"]
)
def test_a_page_without_a_part_or_a_websocket_says_so_and_the_server_is_not_said_to_be_away(
    scripted: Scripted, open_faulty: OpenPage, path: str, where: str
) -> None:
    def drop(route: Route) -> None:
        route.abort()

    page = open_faulty(f"{scripted.url}{path}", answers={"**/common/calibration.js": drop})
    page.click("text=Calibration …")
    expect(page.locator("#notices")).to_contain_text("part of this page could not be loaded")
    expect(page.locator("#guard")).to_have_count(0)
    page.add_init_script("""
      globalThis.WebSocket = class {
        constructor() { setTimeout(() => this.onclose({ reason: "" }), 10); }
        close() {}
      };""")
    page.reload()
    expect(page.locator(where)).to_contain_text("may block WebSockets")


def test_a_silent_server_and_a_fault_of_the_page_are_told_apart(
    scripted: Scripted, open_faulty: OpenPage
) -> None:
    with Play(scripted.node, 5.0):
        held: list[Route] = []

        def hold(route: Route) -> None:
            held.append(route)

        page = open_faulty(scripted.url, answers={"**/tare": hold})
        page.clock.install()
        page.click("#tare")
        until(lambda: page.evaluate("true") and held)
        page.clock.fast_forward(10_000)
        expect(page.locator("#notices")).to_contain_text("did not answer within 10 s")
        page.evaluate("delete window.Request")
        page.evaluate("document.getElementById('notices').replaceChildren()")
        page.click("#tare")
        expect(page.locator("#guard pre")).to_contain_text("Request is not defined")
        expect(page.locator("#notices")).to_be_empty()
        held[0].abort()


def test_a_browser_that_keeps_no_cookies_is_told_so(
    script: Callable[..., Scripted], open_faulty: OpenPage
) -> None:
    server = script(token=TOKEN, is_private=True)

    def drop_cookie(route: Route) -> None:
        if route.request.method != "POST":
            route.continue_()
            return
        sent = {name: route.request.headers[name] for name in ("authorization", "content-type")}
        answer = server.running.http.post("/login", content=route.request.post_data, headers=sent)
        route.fulfill(status=answer.status_code, json=answer.json())

    page = open_faulty(server.url, answers={"**/api/v1/login": drop_cookie})
    page.fill("#token-field", TOKEN)
    page.press("#token-field", "Enter")
    expect(page.locator("#token-why")).to_contain_text("blocks cookies")


def test_a_page_that_was_put_aside_connects_again_and_tells_of_another_version(
    scripted: Scripted, open_faulty: OpenPage
) -> None:
    second_hello = """
      const parse = JSON.parse;
      let hellos = 0;
      JSON.parse = (text) => {
        const value = parse(text);
        if (value?.type === "hello" && hellos++) value.software = "FootTile 99.0";
        return value;
      };"""
    with Play(scripted.node, 5.0):
        page = live(open_faulty(scripted.url, first=second_hello))
        expect(page.locator("#notices")).to_be_empty()
        page.evaluate("dispatchEvent(new PageTransitionEvent('pageshow', { persisted: true }))")
        expect(page.locator("#notices")).to_contain_text("to FootTile 99.0")
        expect(page.locator(LIVE)).to_have_count(1)
        page.click("#notices button:has-text('Reload')")
        expect(page.locator("#notices")).to_be_empty()

"""What a page says of itself: too old a browser, scripts that fail, errors, no answer."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from tests.service.fake_node import Play
from tests.service.running import Running
from tests.waiting import PATIENCE_S, until
from tests.web.login import log_in
from tests.web.scripted import Scripted
from tests.web.test_accessible import SIZES, complaints

pytestmark = pytest.mark.real_time

OpenFaulty = Callable[..., Page]
Answer = Callable[[Route], object]
PAGES = ("/", "/nodes", "/calibrate", "/docs", "/sessions", "/sessions/none")


@pytest.fixture
def open_faulty(browser: Browser) -> Iterator[OpenFaulty]:
    """Opens a page that may complain: with a script of its own first, and answers of the test's."""
    contexts = []

    def open_(
        url: str,
        size: tuple[int, int] = (1366, 768),
        script: str = "",
        answers: dict[str, Answer] | None = None,
    ) -> Page:
        contexts.append(browser.new_context(viewport={"width": size[0], "height": size[1]}))
        log_in(contexts[-1], url)
        page = contexts[-1].new_page()
        page.set_default_timeout(1e3 * PATIENCE_S)
        if script:
            page.add_init_script(script)
        for part, answer in (answers or {}).items():
            page.route(part, answer)
        page.goto(url)
        return page

    yield open_
    for context in contexts:
        context.close()


def script_answer(text: str) -> Answer:
    return lambda route: route.fulfill(body=text, content_type="text/javascript")


@pytest.mark.parametrize("path", PAGES)
@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (script_answer("const = broken"), r"SyntaxError: .*\(/static/common/text\.js:1:7\)"),
        (script_answer("export const older = 1;"), "does not provide an export named"),
        (lambda route: route.abort(), "did not load: http"),
    ],
    ids=["syntax", "older", "absent"],
)
def test_a_page_whose_scripts_fail_says_so_and_what_to_report(
    server: Running, open_faulty: OpenFaulty, path: str, answer: Answer, said: str
) -> None:
    page = open_faulty(f"{server.url}{path}?secret=1", answers={"**/common/text.js": answer})
    guard = page.locator("#guard")
    expect(guard.locator("h2")).to_have_text(re.compile("could not start|Error on this page"))
    expect(guard.locator("pre")).to_contain_text(re.compile(said))
    expect(guard.locator("pre")).to_contain_text("Chrome/")
    expect(guard.locator("pre")).not_to_contain_text("secret")


def test_a_browser_that_is_too_old_is_told_which_ones_are_not(
    server: Running, open_faulty: OpenFaulty
) -> None:
    page = open_faulty(server.url, script="delete Array.prototype.findLast")
    expect(page.locator("#guard h2")).to_have_text("This browser is too old for this page")
    expect(page.locator("#guard p").first).to_contain_text("Firefox 115")
    assert complaints(page) == []


@SIZES
def test_an_error_is_told_once_and_covers_no_control(
    scripted: Scripted, open_faulty: OpenFaulty, size: tuple[int, int]
) -> None:
    with Play(scripted.node, 5.0):
        page = open_faulty(scripted.url, size)
        expect(page.locator("body[data-live=true]")).to_have_count(1)
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
        assert complaints(page) == []
        covered = page.evaluate("""() => {
          const box = document.getElementById("guard").getBoundingClientRect();
          const apart = (rect) => rect.bottom <= box.top || rect.top >= box.bottom;
          const all = [...document.querySelectorAll("header *, #live *, #actions *")];
          const area = ({ width, height }) => width * height;  // an empty box covers nothing
          const isSeen = (e) => e instanceof HTMLElement && area(e.getBoundingClientRect()) > 1;
          const seen = all.filter(isSeen);
          return seen.filter((e) => !apart(e.getBoundingClientRect())).map((e) => e.outerHTML);
        }""")
        assert covered == []
        page.click("#guard button:has-text('Dismiss')")
        expect(guard).to_be_hidden()
        page.evaluate("setTimeout(() => { throw new Error('one more') })")
        page.click("#record")  # the page goes on
        expect(page.locator("#recordings li")).to_have_count(1)
        expect(guard).to_be_hidden()


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda route: route.abort(), "cannot be reached"),
        (
            lambda route: route.fulfill(body="<h1>Log in</h1>", content_type="text/html"),
            "not from a FootTile server",
        ),
        (lambda route: route.fulfill(status=502, body="<h1>Bad</h1>"), "refused: 502"),
        (lambda route: route.fulfill(status=409, json={"detail": "It rests."}), "It rests."),
    ],
    ids=["network", "captive", "proxy", "refused"],
)
def test_each_way_to_fail_has_its_own_words(
    scripted: Scripted, open_faulty: OpenFaulty, answer: Answer, said: str
) -> None:
    with Play(scripted.node, 5.0):
        page = open_faulty(scripted.url, answers={"**/tare": answer})
        page.click("#tare")
        expect(page.locator("#notices")).to_contain_text(said)
        expect(page.locator("#guard")).to_have_count(0)


@pytest.mark.parametrize("path", ["/", "/nodes"])
def test_a_part_of_the_page_that_does_not_come_is_a_refusal(
    scripted: Scripted, open_faulty: OpenFaulty, path: str
) -> None:
    def drop(route: Route) -> None:
        route.abort()

    page = open_faulty(f"{scripted.url}{path}", answers={"**/common/calibration.js": drop})
    page.click("text=Calibration …")
    expect(page.locator("#notices")).to_contain_text("part of this page could not be loaded")
    expect(page.locator("#guard")).to_have_count(0)


@pytest.mark.parametrize(
    ("path", "where"), [("/", "#frozen-reason"), ("/nodes", "#link-down")], ids=["live", "nodes"]
)
def test_a_server_whose_websockets_are_blocked_is_not_said_to_be_away(
    scripted: Scripted, open_faulty: OpenFaulty, path: str, where: str
) -> None:
    blocked = """
      globalThis.WebSocket = class {
        constructor() { setTimeout(() => this.onclose({ reason: "" }), 10); }
        close() {}
      };"""
    page = open_faulty(f"{scripted.url}{path}", script=blocked)
    expect(page.locator(where)).to_contain_text("may block WebSockets")


def test_a_silent_server_and_a_fault_of_the_page_are_told_apart(
    scripted: Scripted, open_faulty: OpenFaulty
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
    script: Callable[..., Scripted], open_faulty: OpenFaulty
) -> None:
    token = "a-token-of-this-test"  # noqa: S105  # of this test
    server = script(token=token, is_private=True)

    def drop_cookie(route: Route) -> None:
        if route.request.method != "POST":
            route.continue_()
            return
        sent = {name: route.request.headers[name] for name in ("authorization", "content-type")}
        answer = server.running.http.post("/login", content=route.request.post_data, headers=sent)
        route.fulfill(status=answer.status_code, json=answer.json())

    page = open_faulty(server.url, answers={"**/api/v1/login": drop_cookie})
    page.fill("#token-field", token)
    page.press("#token-field", "Enter")
    expect(page.locator("#token-why")).to_contain_text("blocks cookies")


def test_a_page_that_was_put_aside_connects_again_and_tells_of_another_version(
    scripted: Scripted, open_faulty: OpenFaulty
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
        page = open_faulty(scripted.url, script=second_hello)
        expect(page.locator("body[data-live=true]")).to_have_count(1)
        expect(page.locator("#notices")).to_be_empty()
        page.evaluate("dispatchEvent(new PageTransitionEvent('pageshow', { persisted: true }))")
        expect(page.locator("#notices")).to_contain_text("to FootTile 99.0")
        expect(page.locator("body[data-live=true]")).to_have_count(1)
        page.click("#notices button:has-text('Reload')")
        expect(page.locator("#notices")).to_be_empty()

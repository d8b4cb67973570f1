"""A web page of an attacker, open in the browser of somebody who may reach the server."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.stage import Served, recording
from tests.web.conftest import CHROMIUM, CHROMIUM_OPTIONS
from tests.web.login import log_in

NAMES = "MAP evil.example 127.0.0.1, MAP rebound.example 127.0.0.1"
"""What a foreign DNS says: its own page is here, and, when asked again, so is our server."""

ASK = """async ([url, method, mode, type, body]) => {
  try {
    const answer = await fetch(url, {
      method, mode, body: body ?? undefined,
      headers: type ? { "Content-Type": type } : {},
      signal: AbortSignal.timeout(3000),
    });
    return [answer.type, answer.status, (await answer.text()).slice(0, 60)];
  } catch (error) { return ["blocked", 0, String(error)]; }
}"""
SOCKET = """async (url) => new Promise((resolve) => {
  const socket = new WebSocket(url, "foottile.v1");
  socket.onopen = () => resolve("open");
  socket.onerror = () => resolve("refused");
  setTimeout(() => resolve("silent"), 3000);
})"""
BEACON = """([url, body]) => navigator.sendBeacon(url, body)"""
FORM = """([url, name, value]) => new Promise((resolve) => {
  const frame = document.createElement("iframe");
  frame.name = "hidden"; document.body.append(frame);
  const form = document.createElement("form");
  Object.assign(form, { action: url, method: "post", enctype: "text/plain", target: "hidden" });
  const field = document.createElement("input");
  Object.assign(field, { name, value }); form.append(field); document.body.append(form);
  form.submit();
  setTimeout(resolve, 300);
})"""
START = '{"node": "bench", "name": "of an attacker"}'


@attack("an attacker's page in a browser", tries=14, soak_tries=400, is_alone=False)
def page_of_an_attacker(play: Play) -> Outcome:
    """Requests, forms, beacons and websockets of a foreign page, and of one rebound by its DNS.

    A node records meanwhile and the browser has logged in, so what is asked for would succeed if it
    were let through: the last request, of the server's own page, does. A try is one of them. It
    fails if a page reads anything of the server's, if a websocket opens, or if anything has changed
    on the server.
    """
    if CHROMIUM is None:
        pytest.skip("no Chromium; on Debian: sudo apt-get install chromium")
    outcome = Outcome()
    with Served(play.folder) as served, _site() as foreign, sync_playwright() as playwright:
        options = [*CHROMIUM_OPTIONS, f"--host-resolver-rules={NAMES}"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        try:
            with recording(served, outcome):
                before = _state(served)
                while outcome.tries < play.tries:
                    _from_another_site(browser, f"http://evil.example:{foreign}", served, outcome)
                    _rebound(browser, served, outcome)
                if _state(served) != before:
                    outcome.failures.append(f"the server has changed: {before} {_state(served)}")
                _of_its_own_page(browser, served, outcome)
        finally:
            browser.close()
    return outcome


def _from_another_site(browser: Browser, site: str, served: Served, outcome: Outcome) -> None:
    with _page(browser, served, site) as page:
        for host in (f"127.0.0.1:{served.port}", f"localhost:{served.port}"):
            api = f"http://{host}/api/v1"
            for request in _requests(api):
                _judge(page.evaluate(ASK, request), f"{site} {request}", outcome)
            for path in ("live", "ingest"):
                _judge_socket(page, f"ws://{host}/api/v1/{path}", outcome)
            page.evaluate(BEACON, [f"{api}/sessions", START])
            outcome.saw("beacon sent in vain")
            # As JSON: {"node": "bench", "name": "x", "notes": "="}
            page.evaluate(FORM, [f"{api}/sessions", START[:-1] + ', "notes": "', '"}'])
            outcome.saw("form sent in vain")


def _rebound(browser: Browser, served: Served, outcome: Outcome) -> None:
    site = f"http://rebound.example:{served.port}"
    with _page(browser, served, site) as page:
        if "FootTile" in page.title():
            outcome.failures.append("the page is served under a foreign name")
        for request in _requests("/api/v1"):
            _judge(page.evaluate(ASK, request), f"{site} {request}", outcome)
        for path in ("live", "ingest"):
            _judge_socket(page, f"ws://rebound.example:{served.port}/api/v1/{path}", outcome)


def _requests(api: str) -> list[list[str | None]]:
    return [
        [f"{api}/sessions", "GET", "cors", None, None],
        [f"{api}/sessions", "POST", "cors", "application/json", START],
        [f"{api}/sessions", "POST", "cors", "text/plain", START],
        [f"{api}/sessions", "POST", "no-cors", "text/plain", START],
        [f"{api}/sessions", "POST", "no-cors", "application/x-www-form-urlencoded", START],
        [f"{api}/nodes/bench/tare", "POST", "no-cors", None, None],
        [f"{api}/trash", "DELETE", "cors", None, None],
        [f"{api}/nodes", "GET", "no-cors", None, None],
    ]


def _judge(answer: Any, what: str, outcome: Outcome) -> None:
    kind, status, text = answer
    if status == 403:
        outcome.saw("refused with 403")
    elif kind == "blocked":
        outcome.saw("kept from the page by the browser")
    elif kind == "opaque":
        outcome.saw("answered, and the page cannot see with what")
    else:
        outcome.failed(f"{what}: {status} {text}")


def _judge_socket(page: Page, url: str, outcome: Outcome) -> None:
    said = page.evaluate(SOCKET, url)
    if said == "refused":
        outcome.saw("websocket refused")
    else:
        outcome.failed(f"{url}: {said}")


def _of_its_own_page(browser: Browser, served: Served, outcome: Outcome) -> None:
    """That the requests would do something, did they come from where they may."""
    with _page(browser, served, served.url) as page:
        _, status, text = page.evaluate(ASK, _requests("/api/v1")[1])
        if status != 201 or page.evaluate(SOCKET, f"ws://127.0.0.1:{served.port}/api/v1/live") != (
            "open"
        ):
            outcome.failures.append(f"its own page is refused as well: {status} {text}")
        for session in served.sessions():
            if session["name"] == "of an attacker":
                served.session(session["id"]).stop()


def _state(served: Served) -> list[Any]:
    """What a foreign page might change."""
    facts = ("id", "name", "state", "notes", "tags")
    sessions = [[session[fact] for fact in facts] for session in served.sessions()]
    trash = served.http.get("/trash").json()["items"]
    tares = served.http.get("/nodes/bench/tares").json()["items"]
    return [sessions, trash, [tare["id"] for tare in tares]]


@contextmanager
def _page(browser: Browser, served: Served, url: str) -> Iterator[Page]:
    context = browser.new_context()
    try:
        log_in(context, served.url)
        page = context.new_page()
        page.goto(url + "/")
        yield page
    finally:
        context.close()


@contextmanager
def _site() -> Iterator[int]:
    """The attacker's web server; its port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>Win a robot</title><body>")

        def log_message(self, *_: Any) -> None:
            pass

    site = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=site.serve_forever, name="attacker")
    thread.start()
    try:
        yield site.server_port
    finally:
        site.shutdown()
        thread.join(5.0)
        site.server_close()

"""A phone beside the robot: a screen that stays on, alerts, and what was missed during sleep."""

from __future__ import annotations

import time

import pytest
from playwright.sync_api import Page, expect

from tests.service.fake_node import Play
from tests.waiting import until
from tests.web.pages import PHONE, SMALL_PHONE, OpenPage, complaints, complaints_at, live
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

LOCKS = """
globalThis.locks = [];
globalThis.refuses = false;
navigator.wakeLock.request = async () => {
  if (refuses) throw new DOMException("low battery", "NotAllowedError");
  const lock = new EventTarget();
  lock.released = false;
  lock.release = async () => {
    lock.released = true;
    lock.dispatchEvent(new Event("release"));
  };
  locks.push(lock);
  return lock;
};
"""
BLOCKED_VIDEO = """
const play = HTMLMediaElement.prototype.play;
let isTapped = false;
addEventListener("pointerdown", () => { isTapped = true; }, true);
HTMLMediaElement.prototype.play = function () {
  return isTapped ? play.call(this) : Promise.reject(new DOMException("", "NotAllowedError"));
};
"""
SPIES = """
globalThis.buzzes = [];
globalThis.tones = [];
navigator.vibrate = (pattern) => buzzes.push(pattern);
const start = OscillatorNode.prototype.start;
OscillatorNode.prototype.start = function (at) {
  tones.push(this.frequency.value);
  start.call(this, at);
};
"""
SOCKETS = """
globalThis.opened = [];
globalThis.resumedMs = null;
globalThis.frameMs = null;
const Plain = WebSocket;
globalThis.WebSocket = class extends Plain {
  constructor(...all) {
    super(...all);
    opened.push(this);
    this.addEventListener("message", ({ data }) => {
      if (resumedMs !== null && data.includes('"type":"frame"')) {
        requestAnimationFrame(() => { frameMs ??= performance.now(); });
      }
    });
  }
};
let tickMs = performance.now();
setInterval(() => {
  if (performance.now() - tickMs > 3000) resumedMs ??= performance.now();
  tickMs = performance.now();
}, 20);
"""


def switch(page: Page, title: str, state: str) -> None:
    """Press a switch of the device's menu, which then shows this state."""
    page.click("#device")
    item = page.get_by_role("menuitemcheckbox", name=title)
    item.click()
    expect(item.locator("small")).to_have_text(state)
    page.keyboard.press("Escape")


def test_the_screen_is_locked_on_and_again_when_the_page_is_back(
    scripted: Scripted, open_page: OpenPage
) -> None:
    page = open_page(scripted.url, *PHONE, first=LOCKS)
    switch(page, "Keep screen on", "screen stays on")
    page.evaluate("locks.at(-1).release()")
    expect(page.locator("#device")).to_have_text("⚠")
    expect(page.locator("#notices")).to_contain_text("The screen may go dark: the device refuses")
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#device")).to_have_text("⋯")
    expect(page.locator("#notices")).not_to_contain_text("dark")
    assert page.evaluate("locks.length") == 2
    page.goto(f"{scripted.url}/nodes")  # remembered
    until(lambda: page.evaluate("locks.length === 1"))
    page.evaluate("refuses = true; locks[0].release()")
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#notices")).to_contain_text("perhaps to save energy")
    page.get_by_role("button", name="Dismiss").click()  # it lies over the button
    expect(page.locator("#device")).to_have_text("⚠")
    page.click("#device")
    assert complaints_at(page, PHONE, SMALL_PHONE) == []
    page.keyboard.press("Escape")
    switch(page, "Keep screen on", "off")
    expect(page.locator("#notices")).not_to_contain_text("dark")


def test_over_plain_http_a_silent_video_keeps_the_screen_on_after_a_tap(
    scripted: Scripted, open_page: OpenPage
) -> None:
    address = scripted.url.replace("127.0.0.1", "192.0.2.1")
    page = open_page(f"{address}/nodes", *PHONE, first=BLOCKED_VIDEO)
    assert page.evaluate("navigator.wakeLock") is None
    switch(page, "Keep screen on", "screen stays on")
    page.reload()
    expect(page.locator("#notices")).to_contain_text("The screen may go dark: tap this page once.")
    page.mouse.click(200, 400)
    expect(page.locator("#notices")).not_to_contain_text("dark")
    video = page.locator("video")
    expect(video).to_have_js_property("paused", False)
    page.wait_for_timeout(3000)  # beyond the first rewind
    expect(video).to_have_js_property("paused", False)
    switch(page, "Keep screen on", "off")
    expect(video).to_have_count(0)


def test_alerts_sound_and_buzz_once_and_their_reasons_stay(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, alive=True) as play:
        page = live(open_page(scripted.url, *PHONE, first=SPIES))
        scripted.node.record(name="before").stop()
        expect(page.locator("#last-session")).to_contain_text("before")
        assert page.evaluate("tones.length + buzzes.length") == 0
        expect(page.locator("#notices")).to_be_empty()
        switch(page, "Sound", "on")
        switch(page, "Vibration", "on")
        assert page.evaluate("[tones.length, buzzes.length]") == [1, 1]
        play.force_n = 200.0
        notices = page.locator("#notices")
        expect(notices).to_contain_text("Tile T01 of bench is saturated.")
        play.force_n = 0.0
        page.wait_for_timeout(500)
        assert page.evaluate("[tones.length, buzzes.length]") == [3, 2]
        page.click("#record")
        expect(page.locator("#recordings li")).to_have_count(1)
        page.wait_for_timeout(1100)  # a second tap within it would be the same press
        page.click("#stop")
        expect(page.locator("#last-session")).to_contain_text("complete")
        elsewhere = scripted.node.record(name="by a program")
        expect(page.locator("#recordings li")).to_have_count(1)
        elsewhere.stop()
        expect(notices).to_contain_text("Recording “by a program” of bench has ended.")
        assert page.evaluate("buzzes.length") == 3
    scripted.node.leave()
    expect(notices).to_contain_text("Node bench is lost.")
    assert page.evaluate("[tones.length, buzzes.length]") == [7, 4]
    expect(notices).to_contain_text("is saturated.")
    assert complaints(page) == []
    notices.get_by_role("button", name="Dismiss").last.click()
    expect(notices).not_to_contain_text("bench")


def test_after_sleep_a_force_is_drawn_within_a_second_and_what_was_missed_is_said(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 5.0):
        kept, ended = (scripted.node.record(name=name) for name in ("mud 1", "mud 2"))
        page = live(open_page(scripted.url, *PHONE, first=SOCKETS))
        expect(page.locator("#recordings li")).to_have_count(2)
        devtools = page.context.new_cdp_session(page)
        devtools.send("Debugger.enable")
        devtools.send("Debugger.pause")  # Chromium freezes no page that is in front
        ended.stop()
        scripted.running.http.post(f"/sessions/{kept.id}/markers", json={"label": "a stone"})
        scripted.node.record(name="mud 3")
        time.sleep(6.0)
        devtools.send("Debugger.resume")
        notices = page.locator("#notices")
        expect(notices).to_contain_text("Back after")
        for text in (
            "Begun: “mud 3” of bench.",
            "Ended: “mud 2” of bench complete.",
            "Still running: “mud 1” of bench.",
            "1 marker set.",
        ):
            expect(notices).to_contain_text(text)
        assert page.evaluate("opened.length") == 2
        until(lambda: page.evaluate("frameMs !== null"))
        assert page.evaluate("frameMs - resumedMs") < 1000.0
        assert complaints(page) == []


def test_a_socket_that_looks_open_is_replaced_as_soon_as_the_page_is_back(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 5.0):
        page = live(open_page(scripted.url, *PHONE, first=SOCKETS))
        back = "document.dispatchEvent(new Event('visibilitychange'));"
        # At once, as any wait may be long on a busy machine: silent for a moment only.
        assert page.evaluate(f"opened[0].onmessage = null; {back} opened.length") == 1
        page.wait_for_timeout(2500)
        assert page.evaluate(f"{back} opened.length") == 2
        live(page)
        expect(page.locator("#notices")).to_be_empty()


def test_a_lost_network_is_told_with_the_node_that_was_lost_meanwhile(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 5.0):
        page = open_page(f"{scripted.url}/nodes", *PHONE)
        expect(page.locator('.node[data-live="true"]')).to_have_count(1)
    scripted.running.stop()
    time.sleep(6.0)
    scripted.running.start()
    notices = page.locator("#notices")
    expect(notices).to_contain_text("Back after")
    expect(notices).to_contain_text("Node bench is lost.")
    assert complaints(page) == []

"""A day in the field: robot, laptop and phone in networks of their own, with all that goes wrong.

The node is switched on first and given no address. Ten trials are recorded from a list on the
phone, with an edge of another instrument in each; the Wi-Fi fails twice, the phone sleeps, the
robot's disk is nearly full. In the end every session is complete and has its edge.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from importlib import resources
from pathlib import Path

import pytest
from playwright.sync_api import CDPSession, Page, expect, sync_playwright

from devices.clock import server_utc_ns
from storage.sessions.folder import Session, SessionsFolder
from tests.devices.array.gpio_chip import FileChip
from tests.faults.disk import small_disk
from tests.field.wifi import Wifi, make_program
from tests.service.cli.outcome import static_only
from tests.service.networks import needs_networks
from tests.service.process import BIN, Process
from tests.tokens import SHARED_TOKEN
from tests.waiting import PATIENCE_S, until
from tests.web.conftest import CHROMIUM, CHROMIUM_OPTIONS

pytest.importorskip("gpiod", reason="sync lines need the extra `gpio`")
pytestmark = [
    needs_networks,
    pytest.mark.process,
    pytest.mark.real_time,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium; on Debian: apt-get install chromium"),
]

ROBOT, LAPTOP, PHONE = 1, 2, 3
TRIALS = [*(f"mud {i}" for i in range(1, 6)), *(f"plate {i}" for i in range(1, 6))]
TRIAL_S = 4
OUTPUT_LINE = 27


class FieldDay:
    """Three machines, the phone's page, and the edges that were sent."""

    def __init__(self, folder: Path, stack: ExitStack, pictures: Path | None) -> None:
        self.folder, self._stack, self._pictures = folder, stack, pictures
        self.wifi = Wifi(stack)
        self._machines = {n: self.wifi.add_machine(n) for n in (ROBOT, LAPTOP, PHONE)}
        self.chip = FileChip(folder / "gpiochip")
        self.edges: dict[str, int] = {}
        """Server's UTC of the edge in each trial, in ns."""
        self.page: Page
        self._devtools: CDPSession

    def start(
        self, machine: int, *words: object, environment: Mapping[str, str] | None = None
    ) -> Process:
        """Start a command on a machine."""
        state = str(self.folder / f"state-{machine}")
        process = Process(
            *words,
            folder=self.folder / f"run-{machine}",
            before=self._machines[machine].before,
            **{"XDG_STATE_HOME": state, **(environment or {})},
        )
        return self._stack.enter_context(closing(process))

    def open_page(self, url: str) -> None:
        """Open the live page on the phone, logged in by the token's link."""
        assert CHROMIUM is not None
        program = make_program(self.folder / "browser", self._machines[PHONE], CHROMIUM)
        playwright = self._stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(executable_path=program, args=CHROMIUM_OPTIONS)
        self._stack.callback(browser.close)
        context = browser.new_context(
            viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True
        )
        self.page = context.new_page()
        self.page.set_default_timeout(1e3 * PATIENCE_S)
        self.page.goto(f"{url}/#token={SHARED_TOKEN}")
        self._devtools = context.new_cdp_session(self.page)
        self._devtools.send("Debugger.enable")
        self.wait_until_live()

    def wait_until_live(self) -> None:
        """Wait until the page shows the present."""
        expect(self.page.locator("body")).to_have_attribute("data-live", "true")

    def take_picture(self, name: str) -> None:
        """Store a picture of the phone, if pictures are wanted."""
        if self._pictures is not None:
            self.page.screenshot(path=self._pictures / f"{name}.png")

    def begin_trial(self) -> str:
        """Press the button of the next trial, and return its name once it is recorded."""
        self.wait_until_live()
        expect(self.page.locator("#trials")).to_have_attribute("data-state", "next")
        name = self.page.locator("#trial-name").inner_text()
        self.page.locator("#trial-record").tap()
        expect(self.page.locator("#trials")).to_have_attribute("data-state", "recording")
        until(lambda: self.chip.is_high(OUTPUT_LINE))
        return name

    def send_edge(self, trial: str) -> None:
        """Send the edge of a trial."""
        t_mono_ns = self.chip.send_edge()
        self.edges[trial] = server_utc_ns() - (time.monotonic_ns() - t_mono_ns)

    def sleep(self) -> None:
        """Let the phone sleep: its page stands still, and its network is off."""
        self._devtools.send("Debugger.pause")  # Chromium freezes no page that is in front
        self.wifi.lose(PHONE)

    def wake(self) -> None:
        """Let the phone wake."""
        self.wifi.restore(PHONE)
        self._devtools.send("Debugger.resume")

    def list_sessions(self) -> list[Session]:
        """Return the laptop's sessions, in the order of their starts."""
        found = SessionsFolder(self.folder / "data" / "sessions").load_all().sessions
        return sorted(found, key=lambda one: one.started_t_ns)

    def wait_until_ended(self, trial: str) -> None:
        """Wait until a trial is no longer recorded."""
        until(lambda: any(s.name == trial and s.state != "recording" for s in self.list_sessions()))


@pytest.fixture
def field(tmp_path: Path) -> Iterator[FieldDay]:
    chosen = os.environ.get("FOOTTILE_PICTURES")
    with ExitStack() as stack:
        yield FieldDay(tmp_path, stack, None if chosen is None else Path(chosen))


def make_scene(field: FieldDay) -> Path:
    text = (resources.files("devices.scene") / "builtin" / "rolling.toml").read_text("utf-8")
    sync = f'[sync]\ngpiochip = "{field.chip.path}"\ninput_line = 17\noutput_line = {OUTPUT_LINE}\n'
    scene = field.folder / "leg.toml"
    scene.write_text(f'calibration = "paper-eq2-shape"\n{static_only(text)}\n{sync}')
    return scene


def play_field_day(field: FieldDay, outage_s: float) -> None:
    """Play the day; each check that it can be used is on the way.

    Args:
        field: the machines.
        outage_s: how long the Wi-Fi fails each time.
    """
    disk = field._stack.enter_context(small_disk(field.folder / "card", 400 << 20))
    field.wifi.lose(ROBOT)
    node = field.start(
        *(ROBOT, "node", "--scene", make_scene(field), "--name", "left"),
        *("--journal", disk.folder / "node"),
        environment=field.chip.environment,
    )
    node.said("frames/s")
    laptop = field.start(LAPTOP, "serve", "--host=0.0.0.0", "--data", field.folder / "data")
    laptop.said("FootTile is at")
    field.wifi.restore(ROBOT)
    node.said("connected to ws://10.77.0.2:8000")
    field.open_page("http://10.77.0.2:8000")
    field.take_picture("1-live")
    set_trials(field)
    page = field.page

    for trial in TRIALS:
        if trial == "mud 3":
            disk.fill(leave_bytes=40 << 20)
            expect(page.locator("#notes")).to_contain_text("less than an hour")
            field.take_picture("3-disk-nearly-full")
            disk.free()
        assert field.begin_trial() == trial
        field.send_edge(trial)
        if trial == "mud 1":
            field.take_picture("2-recording")
        if trial in ("mud 2", "plate 2"):
            field.wifi.lose(ROBOT)
            expect(page.locator("#frozen")).to_be_visible()
            time.sleep(outage_s)
            field.take_picture(f"4-node-lost-{trial.replace(' ', '-')}")
            field.wait_until_ended(trial)
            field.wifi.restore(ROBOT)
        elif trial == "mud 4":
            field.sleep()
            field.wait_until_ended(trial)
            time.sleep(TRIAL_S)
            field.wake()
            expect(page.locator("#notices")).to_contain_text("Ended: “mud 4”")
            field.take_picture("5-back-from-sleep")
        else:
            field.wait_until_ended(trial)
    expect(page.locator("#trials")).to_have_attribute("data-state", "done")
    until(lambda: all(session.state == "sealed" for session in field.list_sessions()))
    field.take_picture("6-all-done")


def set_trials(field: FieldDay) -> None:
    page = field.page
    page.locator("#device").tap()
    page.get_by_role("menuitem", name="Trial list …").tap()
    page.locator("#trials-text").fill("\n".join(f"{name}; field day" for name in TRIALS))
    page.locator("#trials-use").tap()
    expect(page.locator("#trials-rows li")).to_have_count(len(TRIALS))
    page.locator("#trials-stop").fill(str(TRIAL_S))
    page.locator("#trials-stop").dispatch_event("change")
    field.take_picture("1-trials")
    page.get_by_role("button", name="Close").tap()


@pytest.mark.slow(parts=8)
@pytest.mark.parametrize(
    "outage_s", [6.0, pytest.param(60.0, marks=pytest.mark.soak)], ids=["short", "minutes"]
)
def test_every_trial_of_a_field_day_is_complete_and_has_its_edge(
    field: FieldDay, outage_s: float
) -> None:
    play_field_day(field, outage_s)
    sessions = field.list_sessions()
    assert [session.name for session in sessions] == TRIALS
    for session in sessions:
        assert session.tags == ("field day",)
        assert session.ledger is not None
        assert session.ledger.completeness is True, session.name
        (marker,) = session.markers
        assert marker.label == "sync"
        assert marker.bound_ns is not None
        off_ns = abs(marker.t_ns - field.edges[session.name])
        assert off_ns <= marker.bound_ns < 20_000_000, (session.name, off_ns, marker.bound_ns)
    words = [str(BIN / "foottile"), "verify", str(field.folder / "data"), "--json"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]
    assert json.loads(done.stdout)

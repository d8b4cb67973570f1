"""Page of the guided calibration: from the form to a node that uses the result."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from service.server import weighing, weighings
from tests.service.cli.outcome import scene_text, static_only
from tests.service.fake_node import Play
from tests.service.running import Running
from tests.waiting import until
from tests.web.conftest import COMMAND
from tests.web.scripted import Scripted
from tests.web.test_accessible import SIZES, complaints

pytestmark = pytest.mark.real_time

OpenPage = Callable[..., Page]
TOKEN = "a-token-of-this-test"  # noqa: S105  # of this test
STEP_S = 3.0
"""A fit requires steps of at least 2 s."""
LEAD_S = 25
EACH_S = 14.0
"""A rest and a weight: each settles for about 3 s and is held for 3 s."""
FORCES_N = (2.0, 5.0, 10.0, 15.0, 20.0)
SLOW_MS = 1e3 * (LEAD_S + EACH_S + 60)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("REST_S", "HOLD_S"):
        monkeypatch.setattr(weighing, name, STEP_S)


@contextmanager
def foot_with_weights(
    running: Running, folder: Path, environment: dict[str, str]
) -> Iterator[None]:
    """Run an emulated foot of one tile, loaded with five forces after a lead-in."""
    (folder / "one.toml").write_text(static_only(scene_text("standing", 1)))
    rows = ["time_s,cell1_n"]
    for number, force_n in enumerate(FORCES_N):
        begin_s = EACH_S * number
        on_s, off_s = begin_s + 0.5 * EACH_S, begin_s + EACH_S - 0.4
        rows += [f"{begin_s},0", f"{on_s},0", f"{on_s + 0.4},{force_n}", f"{off_s},{force_n}"]
    rows += [f"{EACH_S * len(FORCES_N)},0", f"{EACH_S * len(FORCES_N) + 60},0", ""]
    (folder / "weights.csv").write_text("\n".join(rows))
    command = [
        *(*COMMAND, "node", "--scene", "one.toml", "--server", running.url, "--name", "bench"),
        *("--load", "weights.csv", "--lead-s", str(LEAD_S), "--journal", "journal"),
    ]
    token = {"FOOTTILE_TOKEN": running.shown["Authorization"].split()[-1]}
    node = subprocess.Popen(command, cwd=folder, env=environment | token)
    try:
        yield
    finally:
        node.terminate()
        node.wait(20)


@pytest.mark.slow
def test_a_tile_is_calibrated_and_used_by_its_node(
    server: Running,
    open_page: OpenPage,
    tmp_path: Path,
    field_environment: dict[str, str],
    quick: None,
) -> None:
    with foot_with_weights(server, tmp_path, field_environment):
        page = open_page(f"{server.url}/calibrate", 390, 844)
        expect(page.locator("#tiles input")).to_have_count(1)
        assert complaints(page) == []
        page.check("input[value=sensor]")
        expect(page.locator("#weights")).to_have_value("2 N, 5 N, 10 N, 15 N, 20 N")
        page.fill("#within", "0.5")
        page.fill("#name", "left heel")
        page.click("#start")
        prompt, steps = page.locator("#prompt"), page.locator("#steps li li[data-state=done]")
        expect(prompt).to_have_text("Press T01 until the sensor reads 2 N, and clamp it")
        assert complaints(page) == []
        expect(steps).to_have_count(1, timeout=SLOW_MS)
        expect(page.locator("#repeat")).to_have_text("Repeat 2 N")
        page.reload()  # the server holds the state
        expect(steps).to_have_count(1)
        for count in range(2, 5):
            expect(steps).to_have_count(count, timeout=SLOW_MS)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        expect(page.locator("#result-title")).to_have_text("left heel", timeout=SLOW_MS)
        expect(page.locator("#about")).to_contain_text("force sensor, 5 weights within ±0.5 %")
        expect(page.locator("#result tbody tr")).to_have_count(len(FORCES_N))
        for heading in ("Noise", "Settled"):
            expect(page.get_by_role("columnheader", name=heading)).to_be_in_viewport(ratio=1)
        expect(page.locator("#result svg.curve circle")).to_have_count(len(FORCES_N))
        assert complaints(page) == []
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        page.click("#accept")
        expect(page.locator("#notices")).to_contain_text(
            "bench uses this calibration from the next frame"
        )
        expect(page.locator("#setup")).to_be_visible()
        used = server.http.get("/nodes/bench/calibration").json()
        assert (used["source"], used["calibration"]["name"]) == ("server", "left heel")


@SIZES
def test_a_failed_calibration_shows_its_reason_and_can_be_repeated(
    scripted: Scripted,
    open_page: OpenPage,
    size: tuple[int, int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with Play(scripted.node, 5.0, alive=True):
        page = open_page(f"{scripted.url}/calibrate?node=bench", *size)
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
        assert complaints(page) == []
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
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


def test_a_viewer_sees_the_calibration_and_cannot_change_it(
    script: Callable[..., Scripted], open_page: OpenPage
) -> None:
    server = script(token=TOKEN)
    ticket = server.running.http.post("/tickets", json={"role": "viewer"}).json()["ticket"]
    plan = {"tiles": ["T01"], "weights": ["10 N", "20 N", "30 N", "40 N", "50 N"]}
    with Play(server.node, alive=True):
        page = open_page(f"{server.url}/calibrate#ticket={ticket}")
        expect(page.locator("#setup-viewer")).to_be_visible()
        expect(page.locator("#start")).to_be_hidden()
        server.running.http.post("/nodes/bench/weighing", json=plan)
        expect(page.locator("#prompt")).to_contain_text("T01")
        for button in ("#repeat", "#cancel"):
            expect(page.locator(button)).to_be_hidden()
        server.running.http.delete("/nodes/bench/weighing")
        expect(page.locator("#setup")).to_be_visible()

"""The real page in a real browser, on a real server with a real node of emulated tiles."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from playwright.sync_api import Page, expect

from devices.flags import TileFlag
from devices.frames import NOT_READ, FrameBatch
from tests.service.fake_node import FakeNode, Play
from tests.waiting import until
from tests.web.conftest import Field
from tests.web.login import log_in
from tests.web.pages import PHONE, OpenPage, at_sizes, box_of, live, width_of
from tests.web.scripted import Scripted
from tests.web.session_rows import choose

pytestmark = pytest.mark.real_time


PRESSED_N = (0.0, 6.0, 12.0, 18.0)
"""A known load on the four tiles, held for ten minutes."""
TOLERANCE_N = 2.5
"""Creep and hysteresis of the emulated domes are not modelled yet (docs/method.md)."""


def scene_file(folder: Path, *more: str) -> Path:
    tiles = [
        f'[[tile]]\nserial = "T0{i + 1}"\nmux = 0x70\nchannel = {i}\n'
        f"x_m = {0.014 * i - 0.021:.4f}\ny_m = 0\nz_m = -0.15\n"
        for i in range(4)
    ]
    text = 'name = "known"\n' + "\n".join(tiles) + '\n[ground]\nkind = "trace"\n' + "\n".join(more)
    path = folder / "known.toml"
    path.write_text(text)
    return path


def load_file(folder: Path, forces_n: tuple[float, ...]) -> Path:
    names = ",".join(f"cell{i + 1}_n" for i in range(len(forces_n)))
    values = ",".join(str(f) for f in forces_n)
    path = folder / "load.csv"
    nothing = ",".join("0" for _ in forces_n)
    path.write_text(f"time_s,{names}\n0,{nothing}\n0.2,{values}\n600,{values}\n600.2,{nothing}\n")
    return path


@pytest.fixture(scope="module")
def known(
    tmp_path_factory: pytest.TempPathFactory, field_environment: dict[str, str]
) -> Iterator[Field]:
    folder = tmp_path_factory.mktemp("known")
    field = Field(folder, field_environment)
    field.serve()
    load = load_file(folder, PRESSED_N)
    field.start_node(str(scene_file(folder)), "--load", str(load), "--name", "bench", "--lead-s=2")
    try:
        until(field.is_tared, every_s=0.05)
        yield field
    finally:
        field.close()


def value_of(page: Page, serial: str) -> float:
    text = page.get_attribute(f'#bars [data-serial="{serial}"]', "data-value")
    return float(text) if text else float("nan")


def test_bars_and_grf_follow_a_known_load_and_fit_on_a_phone(
    known: Field, open_page: OpenPage
) -> None:
    page = live(open_page(known.url))
    until(
        lambda: all(
            abs(value_of(page, f"T0{i + 1}") - force_n) < TOLERANCE_N
            for i, force_n in enumerate(PRESSED_N)
        )
    )
    grf_n = float(page.get_attribute("#grf", "data-value") or "nan")
    assert grf_n == pytest.approx(sum(PRESSED_N), abs=2 * TOLERANCE_N)
    # The centre of pressure of that load, in the foot frame
    x_m = float(page.get_attribute("#cop", "data-x-m") or "nan")
    places_m = 0.014 * np.arange(4) - 0.021
    assert x_m == pytest.approx(float(places_m @ PRESSED_N) / sum(PRESSED_N), abs=0.002)
    page.click("#unit-kpa")
    until(lambda: value_of(page, "T04") < 15.0)
    assert value_of(page, "T04") > value_of(page, "T02") > value_of(page, "T01")
    for size in at_sizes(page, PHONE):
        assert width_of(page) == size[0]
        for part in ('#bars [data-serial="T04"]', "#tare", "#record", "#undo", "#marker"):
            expect(page.locator(part)).to_be_in_viewport()


def test_record_marker_stop_download(known: Field, open_page: OpenPage, tmp_path: Path) -> None:
    page = live(open_page(known.url))
    page.fill("#session-name", "mud & <b>stones</b>")
    page.click("#record")
    expect(page.locator("#stop")).to_be_enabled()
    page.fill("#marker-label", "a stone")
    page.press("#marker-label", "Enter")
    until(lambda: known.get("/sessions")["items"][0]["frames"] > 300, every_s=0.05)
    page.click("#stop")
    until(lambda: known.get("/sessions")["items"][0]["state"] == "sealed", every_s=0.05)
    session = known.get("/sessions")["items"][0]
    expect(page.locator("#last-session")).to_contain_text("complete")
    page.click("#to-sessions")
    row = page.locator(f'#sessions [data-session-id="{session["id"]}"]')
    expect(row).to_contain_text("mud & <b>stones</b>")
    with page.expect_download() as download:
        choose(page, row, "Download Parquet")
    path = tmp_path / "session.parquet"
    download.value.save_as(path)
    table = pq.read_table(path)
    seq = table["seq"].to_numpy()
    assert len(seq) == session["frames"] > 300
    assert (np.diff(seq) == 1).all()
    assert (table.schema.field("grf_n").metadata or {})[b"unit"] == b"N"
    events = known.get(f"/sessions/{session['id']}/markers")["items"]
    assert [event["label"] for event in events] == ["a stone"]


def test_a_tare_under_load_is_refused_on_the_page(known: Field, open_page: OpenPage) -> None:
    page = live(open_page(known.url))
    tares = known.get("/nodes/bench/tares")["items"]
    # The lead must no longer be among the last ten seconds: it mostly is not after other tests.
    time.sleep(max(0.0, 10.5 + tares[0]["t_ns"] * 1e-9 - time.time()))
    page.click("#tare")
    expect(page.locator("#notices")).to_contain_text("loaded")
    assert len(known.get("/nodes/bench/tares")["items"]) == len(tares)


def test_a_killed_server_greys_the_page_within_a_second_and_it_comes_back(
    known: Field, open_page: OpenPage
) -> None:
    page = open_page(known.url)
    body = page.locator("body")
    expect(body).to_have_attribute("data-live", "true")
    page.keyboard.press("r")
    expect(page.locator("#stop")).to_be_enabled()
    known.kill_server()
    killed_s = time.monotonic()
    expect(body).to_have_attribute("data-live", "false")
    assert time.monotonic() - killed_s < 1.5  # a second, and what looking takes
    expect(page.locator("#frozen")).to_contain_text("No data")
    known.serve()
    expect(body).to_have_attribute("data-live", "true")
    log_in(page.context, known.url)  # logins end with their server
    # What was recorded when the server was killed goes on, without a gap.
    expect(page.locator("#stop")).to_be_enabled()
    page.keyboard.press("s")
    until(lambda: known.get("/sessions")["items"][0]["state"] == "sealed", every_s=0.05)
    session = known.get("/sessions")["items"][0]
    assert session["complete"] is True
    ledger = known.get(f"/sessions/{session['id']}/ledger")
    assert [part["pending"] for part in ledger["parts"]] == [0]


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
        at_least_n = float(page.inner_text("#grf"))
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

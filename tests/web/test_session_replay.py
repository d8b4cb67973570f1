"""The foot at the cursor of a session's page: its own frames, stepped through and played."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from playwright.sync_api import Page, expect

from devices.flags import TileFlag
from devices.frames import NOT_READ, ArrayInfo, FrameBatch
from tests.builders.arrays import make_servo
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running
from tests.web.pages import OpenPage, box_of

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


ROLLED, SATURATED, UNREAD, LOST = 700, 50, 50, 300


class Rolling(FakeNode):
    """A node whose servo turns a count a frame."""

    @property
    def info(self) -> ArrayInfo:
        return super().info.model_copy(update={"servo": make_servo()})

    def frames(self, n: int, *arguments: Any, **how: Any) -> FrameBatch:
        flags = how.pop("tile_flags", 0)
        batch = super().frames(n, *arguments, **how)
        tile_flags = np.zeros_like(batch.tile_flags)
        tile_flags[:, 1] = flags
        counts = (batch.seq % 400).astype(np.int32) + 1848
        batch = replace(
            batch, tile_flags=tile_flags, servo_counts=counts, servo_age_us=np.zeros_like(counts)
        )
        if flags:
            pressure_raw = batch.pressure_raw.copy()
            pressure_raw[:, 1] = NOT_READ
            batch = replace(batch, pressure_raw=pressure_raw)
        self.sent[-1] = batch
        return batch


@pytest.fixture(scope="module")
def session(server: Running) -> Recording:
    """A foot that rolls over, then a saturated tile, one that is not read, and lost frames."""
    node = Rolling(server)
    node.connect()
    node.tared()
    recording = node.record(name="roll")
    over: Any = np.linspace(0.0, 1.0, ROLLED)[:, None] * [60.0, -60.0] + [5.0, 65.0]
    node.send(200, [0.0, 0.0], alive=True)
    node.send(ROLLED, over)
    node.send(SATURATED, [20.0, 200.0], alive=True)
    node.send(UNREAD, [20.0, 0.0], alive=True, tile_flags=TileFlag.NO_ANSWER)
    node.send(200, [0.0, 0.0], alive=True)
    first = node.seq
    node.frames(LOST)
    node.say_lost(evicted=[[first, first + LOST - 1]])
    node.deliver(100, [20.0, 30.0], alive=True)
    node.finish(recording)
    node.close()
    return recording


@pytest.fixture(scope="module")
def stored(session: Recording) -> dict[str, np.ndarray]:
    """The sealed file as pyarrow reads it; `since_s` are seconds after the first frame."""
    table = pq.read_table(session.folder / "frames.parquet")
    columns = {
        name: table[name].to_numpy(zero_copy_only=False)
        for name in table.column_names
        if name != "marker"
    }
    return columns | {"since_s": (columns["t_ns"] - columns["t_ns"][0]) * 1e-9}


def opened(session: Recording, open_page: OpenPage, from_s: float, to_s: float) -> Page:
    page = open_page(f"{session.running.url}/sessions/{session.id}?from={from_s}&to={to_s}")
    expect(page.locator("#plots[data-settled=true]")).to_have_count(1)
    expect(page.locator("#replay[data-waiting=false]")).to_have_count(1)
    return page


def shows(page: Page, stored: dict[str, np.ndarray], row: int) -> None:
    """The foot, the bars and the numbers are those of this frame of the file."""
    expect(page.locator("#replay")).to_have_attribute("data-seq", str(stored["seq"][row]))
    shown_s = float(page.locator("#replay").get_attribute("data-time-s") or "nan")
    assert shown_s == stored["since_s"][row]
    numbers = {"#grf": ("value", "grf_n", 6e-4), "#cop": ("xM", "cop_x_m", 6e-7)}
    for where, (name, column, within) in numbers.items():
        said = page.locator(where).evaluate("(element, name) => element.dataset[name]", name)
        assert (float(said) if said else np.nan) == pytest.approx(
            float(stored[column][row] if stored[column][row] is not None else np.nan),
            abs=within,
            nan_ok=True,
        )
    for i in range(2):
        bar = page.locator(f"#bars .tile >> nth={i}")
        force_n, sigma_n = (float(stored[f"{of}_{i}"][row]) for of in ("force_n", "force_sigma_n"))
        if stored[f"tile_flags_{i}"][row]:
            expect(bar).to_have_attribute("data-fault", "true")
        elif np.isnan(sigma_n):
            expect(bar).to_have_attribute("data-state", "saturated")
            expect(bar.locator(".value")).to_have_text(f"≥ {int(force_n)}")
        else:
            assert float(bar.get_attribute("data-value") or "nan") == pytest.approx(
                force_n, abs=6e-4
            )
            expect(bar.locator(".sigma")).to_have_text(f"± {1.96 * sigma_n:.1f}")
    angle_deg = np.degrees(float(stored["angle_rad"][row]))
    said = (
        (page.locator("#angle").text_content() or "")
        .replace("\u2212", "-")
        .removeprefix("Foot angle ")
        .removesuffix("°")
    )
    assert float(said) == pytest.approx(angle_deg, abs=0.051)
    contact = {0: "false", 1: "true"}.get(stored["contact"][row], "")
    expect(page.locator("#contact")).to_have_attribute("data-contact", contact)


def test_the_foot_at_the_cursor_is_the_frame_of_the_file(
    session: Recording, stored: dict[str, np.ndarray], open_page: OpenPage
) -> None:
    saturated = 200 + ROLLED + SATURATED // 2
    page = opened(session, open_page, 0.0, 1.0)
    for row in (100, 202, 500, 899, saturated, saturated + UNREAD, len(stored["seq"]) - 60):
        before_s = float(stored["since_s"][row - 1])
        page.goto(f"{page.url.split('?')[0]}?from={before_s}&to={before_s + 0.1}")
        expect(page.locator("#replay[data-waiting=false]")).to_have_count(1)
        page.keyboard.press("ArrowRight")
        shows(page, stored, row)
    expect(page.locator("#replay-lag")).to_contain_text("100 ms of look-ahead")


def test_the_frames_were_worth_comparing(stored: dict[str, np.ndarray]) -> None:
    """Else the test before this one could not fail."""
    rows = slice(200 + ROLLED, 200 + ROLLED + SATURATED)
    assert np.isnan(stored["force_sigma_n_1"][rows]).any()
    assert (stored["tile_flags_1"] > 0).sum() == UNREAD
    assert np.isnan(stored["grf_n"].astype(float)).any()
    assert len(set(np.round(stored["cop_x_m"][300:800].astype(float), 5))) > 40
    assert np.ptp(stored["angle_rad"].astype(float)) > 0.5


def test_keys_step_from_frame_to_frame_over_what_is_lost_and_by_a_tenth_of_a_second(
    session: Recording, stored: dict[str, np.ndarray], open_page: OpenPage
) -> None:
    gap = int(np.argmax(np.diff(stored["seq"].astype(np.int64))))
    assert stored["seq"][gap + 1] - stored["seq"][gap] == LOST + 1
    page = opened(
        session, open_page, float(stored["since_s"][gap - 1]), float(stored["since_s"][-1])
    )
    for row, key in (
        (gap, "ArrowRight"),
        (gap + 1, "ArrowRight"),
        (gap, "ArrowLeft"),
        (gap - 50, "Shift+ArrowLeft"),
        (gap, "Shift+ArrowRight"),
    ):
        page.keyboard.press(key)
        shows(page, stored, row)
    page.keyboard.press("Home")
    for _ in range(3):  # one after the other, however long the first takes
        page.keyboard.press("ArrowLeft")
    shows(page, stored, gap - 3)


def test_space_plays_after_a_click_on_a_button_and_presses_a_button_of_the_keyboard(
    session: Recording, open_page: OpenPage
) -> None:
    page = opened(session, open_page, 0.0, 1.0)
    play = page.locator("#play")
    for button in ('[data-speed="0.1"]', "#zoom-in", "#stance-next"):
        page.click(button)
        page.keyboard.press(" ")
        expect(play).to_have_attribute("data-going", "true")
        page.keyboard.press(" ")
        expect(play).to_have_attribute("data-going", "false")
    page.focus('[data-speed="4"]')
    page.keyboard.press(" ")
    expect(page.locator('[data-speed="4"]')).to_have_attribute("aria-pressed", "true")
    expect(page.locator('[data-speed="4"]')).to_be_focused()
    expect(play).to_have_attribute("data-going", "false")


def test_played_it_ends_with_the_last_frame_and_space_holds_it(
    session: Recording, stored: dict[str, np.ndarray], open_page: OpenPage
) -> None:
    page = opened(session, open_page, 0.0, float(stored["since_s"][-1]))
    play, replay = page.locator("#play"), page.locator("#replay")
    page.click("[data-speed='0.1']")
    page.locator("#plots").focus()
    page.keyboard.press(" ")
    expect(play).to_have_attribute("data-going", "true")
    expect(replay).not_to_have_attribute("data-seq", str(stored["seq"][0]))
    page.keyboard.press(" ")
    expect(play).to_have_attribute("data-going", "false")
    two_pictures = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    page.evaluate(two_pictures)  # the last step before the stop is drawn with the next picture
    held = page.locator("#readout").get_attribute("data-time-s")
    page.evaluate(two_pictures)
    assert page.locator("#readout").get_attribute("data-time-s") == held
    page.click("[data-speed='4']")
    expect(page.locator("[data-speed='4']")).to_have_attribute("aria-pressed", "true")
    page.click("#play")
    expect(play).to_have_attribute("data-going", "false")
    shows(page, stored, len(stored["seq"]) - 1)


def pictures(page: Page, last: int) -> list[int]:
    """Numbers of all frames that are shown when the session is played from its beginning."""
    page.evaluate(
        """() => {
          const replay = document.getElementById('replay');
          window.seen = [];
          const see = new MutationObserver(() => window.seen.push(Number(replay.dataset.seq)));
          see.observe(replay, { attributeFilter: ['data-seq'] });
        }"""
    )
    page.click("#play")
    expect(page.locator("#play")).to_have_attribute("data-going", "false")
    expect(page.locator("#replay")).to_have_attribute("data-seq", str(last))
    seen: list[int] = page.evaluate("window.seen")
    return seen


def test_where_less_motion_is_asked_for_it_is_played_in_few_pictures(
    session: Recording, stored: dict[str, np.ndarray], open_page: OpenPage
) -> None:
    page = opened(session, open_page, 0.0, float(stored["since_s"][-1]))
    page.click("[data-speed='4']")
    wall_s = float(stored["since_s"][-1]) / 4
    page.emulate_media(reduced_motion="reduce")
    last = int(stored["seq"][-1])
    calm = pictures(page, last)
    page.emulate_media(reduced_motion="no-preference")
    smooth = pictures(page, last)
    assert len(calm) <= wall_s / 0.5 + 2
    assert len(smooth) >= wall_s / 0.25 - 1
    there = [seq for seq in smooth if seq][1:]  # the first: it began anew
    assert there == sorted(there)
    assert calm[-1] == smooth[-1] == last


def test_of_a_long_session_few_slices_are_kept(session: Recording, open_page: OpenPage) -> None:
    page = opened(session, open_page, 0.0, 1.0)
    kept = page.evaluate(
        """async (id) => {
          const { Samples } = await import('/static/session/samples.js');
          const { Bins } = await import('/static/session/bins.js');
          const api = await import('/static/common/api.js');
          const whole = new Bins(await api.overview(id, { points: 50 }), { from: -1, to: 1e9 });
          let loaded = () => {};
          const failed = (error) => { throw error; };
          const samples = new Samples(id, whole, 1e9, { loaded: () => loaded(), failed });
          let most = 0;
          for (let t = 0; t < whole.durationS; t += samples.sliceS) {
            while (!samples.at(t).known) {
              const next = new Promise((done) => { loaded = done; });
              samples.request(t, 0);
              if (!samples.at(t).known) await next;
            }
            most = Math.max(most, samples.slices.size);
          }
          return [most, Math.ceil(whole.durationS / samples.sliceS)];
        }""",
        session.id,
    )
    assert 44 <= kept[0] <= 52 < kept[1]


def test_without_a_frame_near_the_cursor_no_other_one_is_shown(
    session: Recording, stored: dict[str, np.ndarray], open_page: OpenPage
) -> None:
    gap = int(np.argmax(np.diff(stored["seq"].astype(np.int64))))
    begin_s, end_s = (float(stored["since_s"][gap + i]) for i in (0, 1))
    assert end_s - begin_s == pytest.approx(2e-3 * (LOST + 1))
    page = opened(session, open_page, begin_s, end_s)
    box = box_of(page.locator("#plots"))
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 60)
    replay = page.locator("#replay")
    expect(replay).to_have_attribute("data-none", "true")
    expect(page.locator("#replay-at")).to_have_text("No frame here")
    expect(page.locator("#grf")).to_have_attribute("data-value", "")
    expect(page.locator("#cop")).to_have_attribute("data-x-m", "")
    page.keyboard.press("ArrowRight")
    expect(replay).to_have_attribute("data-none", "false")
    assert abs(int(replay.get_attribute("data-seq") or 0) - int(stored["seq"][gap])) <= LOST + 2

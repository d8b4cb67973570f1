"""Modules of the pages that compute: all are asked in one page, without a node."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser

from storage.sessions.videos import Alignment
from tests.service.running import Running

pytestmark = pytest.mark.real_time

Ask = Callable[..., Any]
CLOCK = json.loads((Path(__file__).parents[1] / "service/video/clock_page.json").read_text("utf-8"))


@pytest.fixture(scope="module")
def ask(server: Running, browser: Browser) -> Iterator[Ask]:
    """Calls a function of JavaScript with modules of the pages, and one value more."""
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(f"{server.url}/static/tile-reads-nonsense.html")

        def evaluate(modules: str, function: str, value: object = None) -> Any:
            addresses = [f"/static/{name}.js" for name in modules.split()]
            return page.evaluate(
                f"""async ([addresses, value]) => {{
                  const all = await Promise.all(addresses.map((address) => import(address)));
                  return ({function})(Object.assign({{}}, ...all), value);
                }}""",
                [addresses, value],
            )

        yield evaluate


def test_what_people_write_stays_as_it_is(ask: Ask) -> None:
    texts = [
        "third trial, 20 °C",
        "Anlauf über Kies",
        "👩\u200d🔬 first",
        "\u0645\u06cc\u200c\u062e\u0648\u0627",
        "क्\u200dष",
        "two\nlines",
    ]
    assert ask("common/text", "({ printable }, texts) => texts.map(printable)", texts) == texts


def test_instants_are_said_with_the_unit_that_they_are_in(ask: Ask) -> None:
    said = {
        (0.0, 0.001): "0.000 s",
        (59.99, 0.01): "59.99 s",
        (59.999, 0.01): "1:00.00 min",
        (75.123, 0.001): "1:15.123 min",
        (119.999, 0.01): "2:00.00 min",
        (3600.0, 20.0): "60:00 min",
        (70.0, 10.0): "1:10 min",
    }
    function = "({ timeText }, all) => all.map((one) => timeText(...one))"
    assert ask("session/overlay", function, [list(one) for one in said]) == list(said.values())


def test_the_rate_that_was_reached_stands_beside_that_of_the_node(ask: Ask) -> None:
    text, rate_hz = ask(
        "session/header session/bins",
        """({ rateText, Bins }) => {
          const columns = {
            t_first_s: [0, 1, 10], t_last_s: [0.9, 2, 11], part: [0, 0, 1],
            frames: [90, 71, 101], missing: [0, 40, 0],
          };
          const bins = new Bins({ columns }, { from: 0, to: 11 });
          return [rateText({ rateHz: 434.2 }, 449.1), bins.rateHz];
        }""",
    )
    assert text == "434 of 449 frames/s"
    assert rate_hz == pytest.approx(100.0)  # 300 periods in two parts of two seconds and of one


def test_the_instant_of_the_cursor_is_said_beside_that_of_its_frames(ask: Ask) -> None:
    """A pixel column has several frames, and a cursor may stand in a gap."""
    said = ask(
        "session/readout session/bins",
        """({ cursorTextOf, Bins }) => {
          const ends = { t_first_s: [1, 1.01, 2], t_last_s: [1.008, 1.01, 2] };
          const columns = { ...ends, frames: [5, 1, 1] };
          const bins = new Bins({ columns, serials: [] }, { from: 1, to: 2 });
          return [1.005, 1.01, 1.0104, 1.6].map((at) => cursorTextOf(bins, bins.at(at), at));
        }""",
    )
    assert said == [
        "1.005 s (5 frames from 1.000 s)",
        "1.010 s",
        "1.010 s",
        "1.600 s (frame at 2.000 s)",
    ]


def test_of_tiles_in_one_row_the_page_says_that_y_is_not_measured(ask: Ask) -> None:
    alone, plan = ask(
        "session/panels session/readout session/bins",
        """({ panelsOf, readingsOf, Bins }) => {
          const said = (y) => {
            const columns = {
              t_first_s: [0, 1], t_last_s: [0, 1], frames: [1, 1], missing: [0, 0], part: [0, 0],
              contact: [2, 2], grf_lower_bound_n_max: [0, 0],
            };
            for (const name of ["grf_n", "angle_rad", "cop_x_m"]) {
              for (const end of ["min", "max"]) columns[`${name}_${end}`] = [1, 2];
            }
            for (const axis of ["x", "y"]) {
              columns[`cop_${axis}_low_m_min`] = [0.5, 1];
              columns[`cop_${axis}_high_m_max`] = [1.5, 3];
            }
            columns.cop_y_m_min = columns.cop_y_m_max = y;
            const columnsOf = (name) => ({ [`${name}_min`]: [1, 1], [`${name}_max`]: [1, 1] });
            Object.assign(columns, columnsOf("grf_low_n"), columnsOf("grf_high_n"));
            const bins = new Bins({ columns, serials: [], frames_in_bin: 1 }, { from: 0, to: 1 });
            const panels = panelsOf(bins, null);
            const y_read = readingsOf(bins, 0, panels).find(([key]) => key === "cop-y");
            return [panels.map(({ key }) => key).includes("cop-y"), y_read?.[2] ?? null,
              panels.find(({ key }) => key === "cop-x").note ?? null];
          };
          return [said([null, null]), said([1, 2])];
        }""",
    )
    assert alone == [False, "not measured: tiles in one row", "y not measured"]
    assert plan == [True, "1000.0 mm ± 500.0", None]


def test_counts_of_two_kinds_of_chip_have_each_their_own_scale(ask: Ask) -> None:
    ranges, panels, most = ask(
        "session/panels session/readout session/bins",
        """({ panelsOf, readingsOf, Bins }) => {
          const columns = { t_first_s: [0, 1], t_last_s: [0, 1], frames: [1, 1] };
          const serials = [...Array(20).keys()].map(String);
          serials.forEach((_, i) => {
            const counts = i % 2 ? [6400000, i === 5 ? 7360000 : 6500000] : [420, 300];
            columns[`pressure_raw_${i}_min`] = columns[`pressure_raw_${i}_max`] = counts;
            columns[`tile_flags_${i}`] = [0, 0];
          });
          columns.pressure_raw_4_min = columns.pressure_raw_4_max = [400, 400]; // it stands still
          const overview = { columns, serials, counts_fall: serials.map((_, i) => i % 2 === 0) };
          const bins = new Bins(overview, { from: 0, to: 1 });
          return [[0, 4, 5].map((i) => bins.countRange(i)),
            panelsOf(bins, false).slice(0, 2)
              .map(({ unit, factor, group }) => [unit, factor ?? 1, group ?? null]),
            readingsOf(bins, 1, panelsOf(bins, true)).at(-1)[2]];
        }""",
    )
    assert ranges == [
        *({"low": 420, "high": 300}, {"low": 401, "high": 400}, {"low": 6400000, "high": 7360000}),
    ]
    assert panels == [["counts", 1, None], ["million counts", 1e-6, None]]
    assert most.startswith("0 300")


def test_texts_of_the_scales_of_two_tiles_do_not_overlap(ask: Ask) -> None:
    """Text is 12 px high, and the second tile is 7 px below the first."""
    closest_px = ask(
        "session/plots",
        """({ Plots }) => {
          const nothing = () => {};
          const context = { beginPath: nothing, moveTo: nothing, lineTo: nothing, stroke: nothing };
          let closest = Infinity;
          for (const heightPx of [32, 46, 55, 83]) {
            for (let n = 0; n < 500; n++) {
              const rows = [];
              context.fillText = (text, x, y) => rows.push(y);
              for (const top of [0, heightPx + 7]) {
                const box = { left: 0, right: 9, top, bottom: top + heightPx };
                const low = 6.8 + 0.0007 * ((n * (top + 1)) % 97);
                const scale = { low, high: low + 0.002 * (1 + n) };
                const y = (v) => box.bottom - ((v - low) / (scale.high - low)) * heightPx;
                Plots.prototype.drawScale.call({ colours: {} }, context, box, scale, y);
              }
              rows.sort((a, b) => a - b);
              rows.slice(1).forEach((row, i) => { closest = Math.min(closest, row - rows[i]); });
            }
          }
          return closest;
        }""",
    )
    assert closest_px >= 12


def test_of_a_cut_stance_a_bound_of_zero_is_left_out(ask: Ask) -> None:
    found = ask(
        "session/stances",
        """({ FIGURES, figureOf }) =>
          [0, 0.012].map((s) => ({ begun: false, duration_s: s, duration_sigma_s: 0.01 }))
            .map((stance) => figureOf(stance, FIGURES[1]))""",
    )
    assert found == [["\u2013", ""], ["≥\u00a012", "±\u00a020"]]


def test_a_travel_without_a_sigma_is_a_lower_bound_and_counts_in_no_median(ask: Ask) -> None:
    whole: dict[str, Any] = {"begun": True, "ended": True, "cop_x_range_m": 0.02}
    found = ask(
        "session/stances",
        """({ FIGURES, valuesOf }, given) =>
          valuesOf(given, FIGURES.find(({ key }) => key === "travel"))""",
        [whole | {"cop_x_range_sigma_m": sigma_m} for sigma_m in (0.001, None)],
    )
    assert found == [0.02]


def test_of_an_even_number_of_stances_the_median_is_between_the_two_in_the_middle(
    ask: Ask,
) -> None:
    found = ask(
        "session/stances",
        """({ medianOf }) => {
          const of = (...peaks) =>
            medianOf(peaks.map((peak) => (
              { is_whole: true, peak_grf_n: peak, peak_sigma_n: 0.1, duration_s: null })));
          return [of(1, 5, 2), of(4, 1, 2, null, 9), of(null), of()]
            .map((all) => [all.peak_grf_n, all.duration_s]);
        }""",
    )
    assert found == [[2, None], [3, None], [None, None], [None, None]]


def test_a_median_is_of_most_stances_or_of_none(ask: Ask) -> None:
    found = ask(
        "session/stances",
        """({ medianOf }) => {
          const whole = { is_whole: true, begun: true, ended: true };
          const seen = { ...whole, peak_grf_n: 3, peak_sigma_n: 0.1, duration_s: 0.5 };
          const hidden = { ...seen, peak_sigma_n: null };
          const cut = { ...seen, is_whole: false, begun: false };
          return [[seen, cut], [seen, seen, cut], [hidden, seen, seen], [hidden, hidden, seen]]
            .map((all) => [medianOf(all).peak_grf_n, medianOf(all).duration_s]);
        }""",
    )
    assert found == [[None, None], [3, 0.5], [3, 0.5], [None, 0.5]]


def test_the_neighbour_is_that_of_the_cursor_or_the_first_in_view(ask: Ask) -> None:
    found = ask(
        "session/stances",
        """({ neighbour }) => {
          const all = [{ from: 0, to: 1 }, { from: 2, to: 3 }, { from: 4, to: 5 }];
          const view = { from: 1.2, to: 4.5 };
          return [null, 1.5, 2.5, 9].map((s) => [-1, 1].map((by) => neighbour(all, by, s, view)));
        }""",
    )
    assert found == [[2, 1], [0, 1], [0, 2], [2, -1]]  # before it and after it; -1: there is none


def test_sessions_recorded_together_lie_by_the_clock_and_others_by_stances(ask: Ask) -> None:
    """Begin and clock of the left foot; the right one's first frame is 125 ms later."""
    found = ask(
        "session/align",
        """({ alignments }) => {
          const clockOf = (offset_ns) => ({ streams: [{ stretches: [
            { begin_t_ns: 0, end_t_ns: 9e9, offset_ns, drift_ppm: null }] }] });
          const of = ({ ownTake = null, take = null, offset = 3e9, clock = clockOf(5e9) }) => {
            const own = { beginNs: 4e9, durationS: 9, markers: [], take: ownTake,
              offset: () => offset,
              stances: [{ from: 0, is_whole: false }, { from: 2, is_whole: true }] };
            const other = { beginNs: 2.125e9, durationS: 9, events: [], clock, take,
              stances: [{ begin_t_ns: 2.625e9, is_whole: true }] };
            const [{ key, shiftS }, ...more] = alignments(own, other);
            return [key, shiftS, more.map((each) => each.key).sort()];
          };
          const take = { ownTake: "t", take: "t" };
          return [of(take), of({}), of({ ...take, clock: null }), of({ ...take, offset: null }),
            of({ clock: null }), of({ clock: clockOf(5e12) }),
            of({ ownTake: "t", take: "u", clock: null })];
        }""",
    )
    by_clock = ["clock", 0.125, ["contact", "start"]]
    by_start, by_stance = ["start", 0, ["contact"]], ["contact", 1.5, ["start"]]
    assert found == [by_clock, by_clock, by_start, by_start, by_stance, by_stance, by_stance]


def test_tiles_are_compared_by_serial_and_those_of_another_foot_in_their_order(ask: Ask) -> None:
    found = ask(
        "session/beside",
        """({ Beside }) => {
          const matched = (own, theirs) => {
            const nobody = { ask: null, onChange: null, onError: null };
            const beside = new Beside({ name: "", columns: {}, ...nobody });
            const names = theirs.map((_, i) => [`force_n_${i}_max`, []]);
            beside.answer = { serials: theirs, columns: Object.fromEntries(names) };
            beside.matchTiles(own);
            return Object.entries(beside.columns).map(([tile, [least]]) => `${tile}=${least}`);
          };
          return [
            matched(["a", "b"], ["b", "a"]), matched(["a", "b"], ["c", "d"]),
            matched(["a", "b"], ["c", "a"]), matched(["a", "b"], ["c"]),
          ];
        }""",
    )
    assert found == [
        ["tile-0=force_n_1_min", "tile-1=force_n_0_min"],
        ["tile-0=force_n_0_min", "tile-1=force_n_1_min"],
        ["tile-0=force_n_1_min"],
        [],
    ]


def test_from_above_toes_are_up_and_only_a_grid_is_drawn_of_squares(ask: Ask) -> None:
    found = ask(
        "common/foot_layout",
        """({ FootLayout, isGrid }) => {
          const at = (x, y) => ({ serial: "", x_m: x, y_m: y, z_m: 0 });
          const box = { widthPx: 300, heightPx: 300, roomPx: 0, toesUp: true };
          const square = [at(0, 0), at(0.01, 0), at(0, 0.01), at(0.01, 0.01)];
          const diamond = [at(0, 0), at(0.01, 0.01), at(0.02, 0), at(0.01, -0.01)];
          const [heel, toe, left] = new FootLayout(square, box).points;
          return {
            toesAbove: toe.y < heel.y && toe.x === heel.x,
            leftLeft: left.x < heel.x && left.y === heel.y,
            grid: isGrid(square), diamond: isGrid(diamond), line: isGrid([at(0, 0), at(0.01, 0)]),
          };
        }""",
    )
    assert found == {
        "toesAbove": True,
        "leftLeft": True,
        "grid": True,
        "diamond": False,
        "line": False,
    }


def test_a_frame_is_shown_ten_times_a_second_and_what_is_new_at_once(ask: Ask) -> None:
    found = ask(
        "live/pace",
        """({ FramePace }) => {
          const pace = new FramePace();
          const node = {};
          const of = (tile_flags, force_n) =>
            ({ tile_flags, force_n, saturated: [false], frame_flags: 0, estimate_flags: 0 });
          const steady = of([0], [1]);
          return {
            first: pace.isDue(node, steady, 1000),
            same: pace.isDue(node, steady, 9000),
            another: pace.isDue(node, of([0], [2]), 9010),
            soonAfter: pace.isDue(node, of([0], [3]), 9040),
            faultAtOnce: pace.isDue(node, of([1], [null]), 9043),
            knownAgainAtOnce: pace.isDue(node, of([0], [4]), 9046),
            nodeSaysMore: pace.isDue({}, of([0], [5]), 9049),
            later: pace.isDue({}, of([0], [6]), 9300),
          };
        }""",
    )
    not_due = [what for what, is_due in found.items() if not is_due]
    assert not_due == ["same", "soonAfter"]


def test_whatever_asks_for_a_picture_there_is_one_in_a_display_frame(ask: Ask) -> None:
    drawn = ask(
        "live/pace",
        """async ({ Pace }) => {
          let drawn = 0;
          const pace = new Pace(() => { drawn += 1; });
          const frame = () => new Promise(requestAnimationFrame);
          for (let i = 0; i < 5; i++) pace.request();
          await frame();
          const first = drawn;
          pace.request();
          await frame();
          clearTimeout(pace.timer);
          return [first, drawn];
        }""",
    )
    assert drawn == [1, 2]


def test_a_picture_that_moves_on_is_that_which_is_drawn_at_once(ask: Ask) -> None:
    seen = ask(
        "live/strip",
        """({ Strip }) => {
          const points = Array.from({ length: 400 }, (_, i) => ({ timeS: i / 20 }));
          const draw = (context, i, x) => {
            context.fillStyle = i % 7 ? "#000" : "#f00";
            context.fillRect(x(points[i].timeS) - 2, 0, 2, 10);
          };
          const how = (endS) => ({ endS, windowS: 10, widthPx: 400, heightPx: 10, key: "one" });
          const moved = new Strip();
          let drawn = 0;
          for (let n = 200; n <= 400; n += 3) {
            moved.draw(points.slice(Math.max(0, n - 201), n), how(n / 20), (context, i, x) => {
              const at = Math.max(0, n - 201) + i;
              drawn += n > 200;
              draw(context, at, x);
            });
          }
          const once = new Strip();
          const last = points.slice(197, 398);
          once.draw(last, how(398 / 20), (context, i, x) => draw(context, 197 + i, x));
          const red = ({ canvas, context }) => {
            const row = context.getImageData(0, 5, canvas.width, 1).data;
            return [...Array(canvas.width).keys()].filter((i) => row[4 * i] > 128);
          };
          return { drawn, moved: red(moved), once: red(once) };
        }""",
    )
    assert seen["drawn"] == 198  # each point once
    assert len(seen["once"]) > 20
    moved, once = np.array(seen["moved"]), np.array(seen["once"])
    for some, others in ((moved, once), (once, moved)):
        inside = some[some > 4]
        assert np.abs(inside[:, None] - others).min(axis=1).max() <= 1


def test_the_clock_page_writes_the_code_that_films_are_read_for(ask: Ask) -> None:
    cells = ask(
        "clock/code",
        """({ cellsOf }, examples) =>
          examples.map((one) => cellsOf(one.t_ms, one.bound_ms, one.refresh_ms))""",
        CLOCK["examples"],
    )
    assert cells == [example["cells"] for example in CLOCK["examples"]]
    drawn = ask(
        "clock/code",
        """({ drawCode, UNITS }, cells) => {
          const canvas = new OffscreenCanvas(UNITS.across, UNITS.down);
          const context = canvas.getContext("2d");
          drawCode(context, cells);
          const { data } = context.getImageData(0, 0, UNITS.across, UNITS.down);
          return [...data].filter((_, i) => i % 4 === 0);
        }""",
        cells[1],
    )
    page = np.array(drawn).reshape(CLOCK["units"][1], CLOCK["units"][0])
    expected = np.full_like(page, 255)
    for tag in CLOCK["tags"]:
        left, top = tag["at"]
        for row, black in enumerate(tag["black"]):
            expected[top + row, left : left + 6] = [0 if bit == "1" else 255 for bit in black]
    left, top = CLOCK["cells_at"]
    size, across = CLOCK["cell_units"], CLOCK["cells_per_row"]
    for number, bit in enumerate(cells[1]):
        x, y = left + size * (number % across), top + size * (number // across)
        expected[y : y + size, x : x + size] = 0 if bit == "1" else 255
    assert (page == expected).all()


def test_the_shortest_round_trip_tells_the_servers_time_until_it_is_too_old(ask: Ask) -> None:
    found = ask(
        "clock/code",
        """({ Offset, statedMs }) => {
          const offset = new Offset();
          const seen = [offset.boundMs(0)];
          const note = (...all) => {
            offset.note(...all);
            seen.push([offset.best.aheadMs, offset.boundMs(all[2])]);
          };
          note(0, 5100, 9); // a round trip of 9 ms
          note(1000, 6001.5, 1003);
          note(2000, 7011, 2009); // longer, and no better
          note(60000, 65000, 60005); // the drift has made the former worse
          note(61000, 99000, 61007); // one of the clocks was set
          return [seen, [0.2, 3, 62.5, NaN, Infinity].map(statedMs)];
        }""",
    )
    (unknown, *seen), stated = found
    assert unknown in (None, float("inf"))
    ahead_ms, bound_ms = zip(*seen, strict=True)
    assert ahead_ms == pytest.approx((5095.5, 5000.0, 5000.0, 4997.5, 37996.5))
    assert bound_ms == pytest.approx((5.0, 2.0, 2.1006, 3.0, 4.0))
    assert stated == [1, 3, 63, 63, 63]


def test_a_films_time_and_the_sessions_are_those_of_the_server(ask: Ask) -> None:
    alignment = Alignment(
        method="contact",
        film_s=3.0,
        t_ns=1_764_268_887_000_000_000,
        drift=30e-6,
        sigma_ns=2e6,
        sigma_drift=20e-6,
        pair_count=4,
        rejected_count=1,
    )
    begin_ns = alignment.t_ns - 5_000_000_000
    film_s = np.array([0.0, 3.0, 603.0])
    session_s, back_s, half_s, text = ask(
        "session/film_time",
        """({ Line }, [alignment, beginNs, films]) => {
          const line = new Line(alignment, beginNs);
          const sessions = films.map((filmS) => line.toSession(filmS));
          const halves = films.map((filmS) => line.halfWidth(filmS));
          return [sessions, sessions.map((timeS) => line.toFilm(timeS)), halves, line.text];
        }""",
        [alignment.model_dump(), begin_ns, film_s.tolist()],
    )
    expected_s = 5.0 + 1e-9 * alignment.to_session_ns(film_s)
    np.testing.assert_allclose(session_s, expected_s, atol=1e-6)
    np.testing.assert_allclose(back_s, film_s, atol=1e-9)
    np.testing.assert_allclose(half_s, 1.96e-9 * alignment.compute_sigma_ns(film_s))
    assert text.replace("\xa0", " ") == (
        "Aligned by contact: the film begins at 1.9999 s \u00b1 3.9 ms (95 %), "
        "drift 30 \u00b1 39 ppm, from 4 pairs of instants, 1 left out: they contradict the others."
    )


def test_a_picture_is_the_nearest_one_and_a_pair_is_as_sure_as_a_person(ask: Ask) -> None:
    nearest, pairs, texts = ask(
        "session/film_time",
        """({ pictureAt, pairOf, halfWidthText }) => {
          const times = [0, 0.02, 0.04, 0.1]; // two pictures are dropped
          const at = [-1, 0.009, 0.011, 0.069, 0.071, 9];
          return [
            at.map((filmS) => pictureAt(times, filmS)),
            ["hand", "contact"].map((method) => pairOf(method, times, 2, 1.5, 1e18, 0.012)),
            [1.2e-3, 45.4e-3, 1.26, 5e-5].map(halfWidthText),
          ];
        }""",
    )
    assert nearest == [0, 0, 1, 2, 3, 3]
    by_hand, by_contact = pairs
    assert (by_hand["film_s"], by_contact["film_s"]) == pytest.approx((0.04, 0.03))
    assert by_hand["t_ns"] == 1_000_000_001_500_000_000
    assert abs(by_contact["t_ns"] - 1_000_000_001_494_000_000) < 1000
    assert by_hand["sigma_ns"] == pytest.approx(1e9 * np.hypot(0.04, 0.012) / 12**0.5)
    assert [text.replace("\xa0", " ").removesuffix(" (95 %)") for text in texts] == [
        *("\u00b1 1.2 ms", "\u00b1 45 ms", "\u00b1 1.3 s", "\u00b1 0.050 ms"),
    ]


BINS = """
  const binsOf = ({ times, values, half, framesInBin = 1, frames = 1, lasts = times }) => {
    const all = (value) => times.map(() => value);
    const unknown = ["grf_lower_bound_n_max", ...["x", "y"].flatMap((axis) =>
      ["min", "max"].map((end) => `cop_${axis}_m_${end}`))];
    const columns = {
      ...Object.fromEntries(unknown.map((name) => [name, all(null)])),
      t_first_s: times, t_last_s: lasts, part: all(0), missing: all(0), frames: all(frames),
      grf_n_min: values, grf_low_n_min: values.map((one) => one - half),
      grf_n_max: values, grf_high_n_max: values.map((one) => one + half),
    };
    return new Bins({
      frames_in_bin: framesInBin, duration_s: 9, serials: [], begin_t_ns: 0, columns,
    }, { from: 0, to: 9 });
  };
"""


@pytest.mark.parametrize(
    ("values", "half_n", "low", "high"),
    [
        ([0.0, 0.5, -0.3], 16.0, -0.8, 1.0),  # noise: a newton keeps half of the axis
        ([0.0, 60.0], 16.0, -16.0, 76.0),  # narrower than the force: all of it
        ([40.0, 40.1], 2.0, 0.0, 42.1),
        ([0.0, 8.0], 16.0, -4.0, 12.0),
    ],
)
def test_the_axis_is_that_of_the_force_however_wide_its_interval_is(
    ask: Ask, values: list[float], half_n: float, low: float, high: float
) -> None:
    found = ask(
        "session/bins session/scales session/panels",
        """({ Bins, panelsOf, scalesOf }, given) => {"""
        + BINS
        + """
          const bins = binsOf({ times: given.values.map((_, i) => i), ...given });
          const panels = panelsOf(bins, false);
          const plots = { panels, best: () => bins, stances: [], scaled: () => 180, beside: null };
          return scalesOf(plots, { from: 0, to: 9 }).get("grf");
        }""",
        {"values": values, "half": half_n},
    )
    room = 0.06 * (high - low)
    assert found["low"] == pytest.approx(low - room * (low != 0))
    assert found["high"] == pytest.approx(high + room)


def test_a_pause_without_frames_is_a_gap_and_the_pace_of_a_slow_node_is_none(ask: Ask) -> None:
    function = (
        "({ Bins }, given) => {"
        + BINS
        + "const bins = binsOf(given);"
        + "return given.times.map((_, i) => [bins.isAdjacent(i), bins.isMostlyGap(i)]); }"
    )
    every_s = 0.004  # half of the slots of 500 a second
    times = [i * every_s for i in range(10)]
    after = [0.020 + i * every_s for i in range(10, 20)]
    found = ask("session/bins", function, {"times": times + after, "values": [0] * 20, "half": 1})
    assert [adjacent for adjacent, _ in found] == [False] + 9 * [True] + [False] + 9 * [True]
    # Of a merged bin only its length tells that it has a gap in it.
    firsts = [0.4 * i for i in range(5)] + [5.0]
    lasts = [first + 0.396 for first in firsts[:4]] + [4.996, 5.396]
    merged = {"times": firsts, "lasts": lasts, "values": [0] * 6, "half": 1}
    found = ask("session/bins", function, {**merged, "frames": 100, "framesInBin": 128})
    assert [mostly for _, mostly in found] == 4 * [False] + [True, False]


POINTS = """({ Points }, { spans, rateHz }) => {
  const points = new Points();
  points.periodS = 1 / rateHz;
  let seq = -1;
  for (const [n, timeS] of spans) {
    points.add({ seq_first: seq + 1, seq: seq + n, n, t_ns: timeS * 1e9, grf_n: 1 }, timeS * 1e3);
    seq += n;
  }
  return points.all.map(({ gap, fromS }) => [gap, fromS]);
}"""


def test_a_live_gap_is_one_of_time_too_and_a_band_begins_with_its_own_frames(ask: Ask) -> None:
    spans = [[16, 100 + 0.032 * i] for i in range(1, 9)]
    end_s = spans[-1][1]
    spans += [[16, end_s + 0.112], [16, end_s + 0.144]]  # 80 ms were not sampled before the first
    found = ask("live/points", POINTS, {"spans": spans, "rateHz": 500})
    assert [gap for gap, _ in found] == [True] + 7 * [False] + [True, False]
    assert found[-2][1] == pytest.approx(end_s + 0.112 - 15 * 0.002)
    assert found[-1][1] == pytest.approx(end_s + 0.112)
    # Once a second, of a node that samples each third slot: that is its pace.
    slow = [[167, 100.0 + i] for i in range(8)]
    found = ask("live/points", POINTS, {"spans": slow, "rateHz": 500})
    assert [gap for gap, _ in found][2:] == 6 * [False]

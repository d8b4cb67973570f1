"""A session's page with something beside it: a force plate, or another session."""

from __future__ import annotations

import re
from urllib.parse import urlencode

import numpy as np
import pyarrow.parquet as pq
import pytest
import scipy.stats
from playwright.sync_api import Page, expect

from tests.service.fake_node import FakeNode
from tests.service.plates import LAG_S, compare, hopped, write_plate
from tests.service.recording import Recording
from tests.service.running import Running
from tests.web.pages import DESK, PHONE, OpenPage, complaints_at
from tests.web.session_page import grf

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


PLATE = "plate <b>1"
STONE = "a stone"


def add_marker(session: Recording, frame: int) -> int:
    """Set a marker at a frame; return its time."""
    t_ns = int(session.column("t_ns")[frame])
    answer = session.running.http.post(
        f"{session.url}/markers", json={"label": STONE, "t_ns": t_ns}
    )
    assert answer.status_code == 201
    return t_ns


@pytest.fixture(scope="module")
def compared(server: Running, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Seven stances that a plate has seen, too, and a limit that is missed."""
    node = FakeNode(server, "left")
    node.connect()
    node.tared()
    session = hopped(node, name="hops")
    node.close()
    plate = tmp_path_factory.mktemp("plate") / f"{PLATE}.csv"
    write_plate(session, plate)
    limits = "grf_mae_n=2,peak_mae_n=0.001"
    assert compare(session, plate, "--remove-offset", "--limits", limits) == 3
    add_marker(session, 700)
    return session


@pytest.fixture(scope="module")
def other(server: Running) -> Recording:
    """A longer rest, and then one stance of 95 N with a peak of a single frame."""
    node = FakeNode(server, "right")
    node.connect()
    node.tared()
    session = node.record(name="others")
    node.send(900, [0.0, 0.0], alive=True)
    node.send(150, [30.0, 65.0], alive=True)
    node.send(1, [30.0, 80.0])
    node.send(150, [30.0, 65.0], alive=True)
    node.deliver(300, [0.0, 0.0], alive=True)
    node.finish(session)
    node.close()
    add_marker(session, 950)
    return session


def url_of(session: Recording, **query: object) -> str:
    return f"{session.running.url}/sessions/{session.id}?{urlencode(query)}"


def beside(page: Page) -> tuple[float, float, float, float]:
    """Least and greatest force of what is beside, and from when to when it is in view."""
    plots = page.locator("#plots[data-settled=true][data-beside-max]:not([data-beside-max=''])")
    expect(plots).to_have_count(1)
    names = ("min", "max", "first-s", "last-s")
    least, most, first, last = (float(plots.get_attribute(f"data-beside-{n}") or "") for n in names)
    return least, most, first, last


@pytest.mark.parametrize("view", [{}, {"from": 1.0, "to": 3.0}, {"from": 2.9, "to": 2.94}])
def test_a_plate_lies_over_our_force_and_no_peak_of_it_hides(
    compared: Recording, open_page: OpenPage, view: dict[str, float]
) -> None:
    (folder,) = (compared.folder / "comparisons").iterdir()
    kept = pq.read_table(folder / "series.parquet")
    begin_ns = int(compared.column("t_ns")[0])
    since_s = (kept["t_ns"].to_numpy() - begin_ns) * 1e-9
    theirs_n = kept["reference_grf_n"].to_numpy()
    page = open_page(url_of(compared, reference=folder.name, **view))
    least_n, most_n, first_s, last_s = beside(page)
    if view:
        assert first_s <= view["from"] + 0.01
        assert last_s >= view["to"] - 0.01
    inside = (since_s >= first_s - 1e-6) & (since_s <= last_s + 1e-6)
    assert most_n == pytest.approx(float(theirs_n[inside].max()), abs=1e-5)
    assert least_n == pytest.approx(float(theirs_n[inside].min()), abs=1e-5)
    panels = page.locator("#plots").get_attribute("data-panels") or ""
    assert panels.split()[:2] == ["grf", "difference"]
    expect(page.locator("#legend [data-kind=beside]")).to_have_text(folder.name)


def test_figures_of_a_comparison_are_said_in_words_with_limits_met_or_missed(
    compared: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(compared))
    name = compared.running.http.get(f"{compared.url}/comparisons").json()["items"][0]["name"]
    page.select_option("#beside", f"reference:{name}")
    says = page.locator("#report-summary")
    expect(says).to_contain_text("1 of 2 limits missed")
    expect(says).to_contain_text(f"Reference clock: {1e3 * LAG_S:.0f}.")
    expect(says).to_contain_text("corrected")
    rows = page.locator("#report-rows")
    expect(rows.locator("[data-figure=grf_mae_n]")).to_contain_text("met: 2.00 N")
    expect(rows.locator("[data-figure=peak_mae_n][data-missed=true]")).to_contain_text("missed")
    report = compared.running.http.get(f"{compared.url}/comparisons/{name}").json()["report"]
    shown = rows.locator("[data-figure=grf_mae_n] td").nth(1).text_content() or ""
    mean_n = report["figures"]["grf_mae_n"]["mean"]
    assert float(shown.split()[0]) == pytest.approx(mean_n, abs=6e-4)
    expect(page.locator("#report-notes li")).to_have_count(len(report["notes"]))
    expect(page).to_have_url(re.compile("reference="))
    beside(page)
    page.select_option("#beside", "")
    expect(page.locator("#report-card")).to_be_hidden()
    expect(page.locator("#legend [data-kind=beside]")).to_have_count(0)
    expect(page).not_to_have_url(re.compile("reference="))


def test_another_session_is_laid_over_by_start_contact_or_marker_and_says_how_far_it_moved(
    compared: Recording, other: Recording, open_page: OpenPage
) -> None:
    since_s, grf_n = grf(other)
    page = open_page(url_of(other))
    page.get_by_role("button", name="Compare with").click()  # no plate has seen this one
    expect(page.locator("#beside")).to_be_focused()
    expect(page.locator(f"#beside option[value='with:{compared.id}']")).to_have_count(1)
    page.goto(url_of(compared))
    page.select_option("#beside", f"with:{other.id}")
    shifts = {"start": 0.0, f"marker:{STONE}": (700 - 950) * 2e-3}
    http = compared.running.http
    first_s = [
        (http.get(f"{s.url}/stances").json()[0]["begin_t_ns"] - int(s.column("t_ns")[0])) * 1e-9
        for s in (compared, other)
    ]
    shifts["contact"] = first_s[0] - first_s[1]
    says = page.locator("#beside-summary")
    for key, shift_s in shifts.items():
        page.select_option("#beside-align", key)
        expect(says).to_have_attribute("data-shift-s", re.compile("."))
        moved_s = float(says.get_attribute("data-shift-s") or "nan")
        assert moved_s == pytest.approx(shift_s, abs=1e-5)
        if shift_s:
            expect(says).to_contain_text(f"shifted by {shift_s:.3f} s".replace("-", "\u2212"))
        least_n, most_n, begin_s, end_s = beside(page)
        inside = (since_s + moved_s >= begin_s - 1e-6) & (since_s + moved_s <= end_s + 1e-6)
        assert most_n == pytest.approx(float(np.nanmax(grf_n[inside])), abs=1e-5)
        assert least_n == pytest.approx(float(np.nanmin(grf_n[inside])), abs=1e-5)
    assert most_n == pytest.approx(110.0, abs=0.1)  # of the single frame
    expect(page).to_have_url(re.compile(f"with={other.id}&align=contact"))
    again = open_page(page.url)
    assert beside(again) == pytest.approx((least_n, most_n, begin_s, end_s))
    assert float(says.get_attribute("data-shift-s") or "nan") == pytest.approx(shifts["contact"])
    for _ in range(2):
        again.keyboard.press("+")
    expect(again).to_have_url(re.compile(f"with={other.id}.*from="))
    beside(again)


def test_the_difference_of_two_sessions_has_the_interval_of_a_welch_test(
    compared: Recording, other: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(compared, **{"with": other.id}))
    says = re.compile(
        r"\(recorded \d+ s later\): aligned at the first whole stance \(shifted by .* s\)\.$"
    )
    expect(page.locator("#beside-summary")).to_have_text(says)
    expect(page.locator("#differences-rows tr")).to_have_count(4)
    head = page.locator("#differences-card thead")
    expect(head).to_contain_text(
        re.compile(r"hops \(\d+\), ±\ssd.*others \(\d+\), ±\ssd.*Newer \u2212 older, ±\s95\s%")
    )
    expect(head.get_by_title("others", exact=True)).to_be_visible()
    verdict = page.locator("#differences-verdict")
    expect(verdict).to_have_text("No differences: each session needs 3 whole stances.")
    values = ([9.6, 9.9, 9.1, 9.4], [10.2, 10.9, 9.8])
    found = page.evaluate(
        """([own, other]) => import("/static/session/differences.js").then((module) => {
          const stances = (values) => values.map((n) => (
            { is_whole: true, begun: true, ended: true, peak_grf_n: n }));
          const draw = (older, newer) => module.drawDifferences(
            { name: "A", stances: stances(older), tares: [{ t_ns: 0, source: "flight" }] },
            { name: "B", stances: stances(newer), tares: [] });
          const verdict = document.getElementById("differences-verdict");
          draw([20, 21, 22], [11, 12, 13]);
          const verdicts = [verdict.textContent];
          draw([20, 21, 22], [20, 21, 23]);
          verdicts.push(verdict.textContent);
          draw(own, other);
          const { textContent } = document.querySelector("[data-figure=peak]");
          draw(own, other.slice(1));
          const cell = document.querySelector("[data-figure=peak] td:last-child").textContent;
          const moments = module.momentsOf;
          const { mean, half } = module.differenceOf(moments(own), moments(other));
          draw([22.12, 22.14, 22.16], [22.15, 22.17, 22.19]);
          const fine = document.querySelector("[data-figure=peak]").textContent;
          const same = module.differenceOf(moments([9, 9, 9]), moments([8, 8, 8])).half;
          const tares = document.getElementById("differences-tares").textContent;
          return { textContent, cell, mean, half, same, fine, verdicts, tares };
        })""",
        values,
    )
    welch = scipy.stats.ttest_ind(values[1], values[0], equal_var=False).confidence_interval(0.95)
    assert found["mean"] == pytest.approx((welch.low + welch.high) / 2)
    assert found["half"] == pytest.approx((welch.high - welch.low) / 2, rel=0.03)
    assert np.isnan(found["same"]), "no scatter is no certainty"
    assert f"0.8 ± {found['half']:.1f}" in found["textContent"]
    assert re.search("Different tares.*A: .* automatically, in the air; B: none", found["tares"])
    # 22.1 and 22.2 with a difference of 0.0 contradict each other.
    assert re.search(r"22\.14 ± 0\.02.*22\.17 ± 0\.02.*0\.03 ± ", found["fine"])
    assert found["verdicts"] == [
        "Different at 95 %: peak force smaller by 9.0 N (B against A).",
        "No figure differs at 95 %.",
    ]
    assert not re.search(r"[0-9]", found["cell"])  # two stances do not bound their scatter


def test_another_session_is_told_by_its_node_and_has_its_stances_and_tiles(
    compared: Recording, other: Recording, open_page: OpenPage
) -> None:
    page = open_page(url_of(compared, **{"with": other.id}))
    beside(page)
    expect(page.locator("#legend [data-kind=own]")).to_have_text("hops, left")
    expect(page.locator("#legend [data-kind=beside]")).to_have_text(
        "others, right: aligned at the first whole stance"
    )
    page.locator("#overlay-card").scroll_into_view_if_needed()
    spread = page.locator("#overlay-legend [data-kind=beside]")
    expect(spread).to_contain_text("others, right: mean")
    page.click("#as-heat")
    panels = page.locator("#plots")
    expect(panels).to_have_attribute("data-panels", re.compile("tiles beside-tiles"))
    page.select_option("#beside", "")
    expect(panels).not_to_have_attribute("data-panels", re.compile("beside-tiles"))
    expect(spread).to_have_count(0)
    page.goto(url_of(other, **{"with": compared.id}))  # the older session is first here, too
    expect(page.locator("#differences-card thead")).to_have_text(re.compile(r"hops.*others.*Newer"))


def test_a_damaged_comparison_is_said_to_be_and_the_page_stays(
    compared: Recording, open_page: OpenPage
) -> None:
    folder = compared.folder / "comparisons" / "damaged"
    folder.mkdir()
    (folder / "compare.json").write_text('{"reference": "x"}')
    page = open_page(url_of(compared, reference="damaged"))
    expect(page.locator("#beside-summary")).to_contain_text(
        "it has no hash: it was cut off or edited"
    )
    expect(page.locator("#plots[data-settled=true]")).to_have_count(1)
    (folder / "compare.json").unlink()
    folder.rmdir()


def test_axe_has_nothing_to_complain_of_with_something_beside(
    compared: Recording, open_page: OpenPage
) -> None:
    name = compared.running.http.get(f"{compared.url}/comparisons").json()["items"][0]["name"]
    page = open_page(url_of(compared, reference=name, **{"from": 2, "to": 3}), *PHONE)
    beside(page)
    expect(page.locator("#report-rows tr").nth(5)).to_be_attached()
    page.keyboard.press("ArrowRight")
    expect(page.locator("#readout [data-key=beside]")).to_contain_text("N")
    assert complaints_at(page, PHONE, DESK) == []

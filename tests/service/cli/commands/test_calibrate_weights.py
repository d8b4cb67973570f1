"""`foottile calibrate --live`: dead weights on a tile, guided step by step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from devices.arrays import Floats
from devices.chips.mpl115a2 import MPL115A2
from devices.chips.pressure_chips import Compensation
from service.estimation.calibration import Calibration
from service.estimation.dead_weights import (
    STANDARD_GRAVITY_M_S2,
    check_and_label_weights,
    parse_weight,
)
from service.estimation.fitting.rig.indentation import Indentation
from service.estimation.fitting.weights_fit import fit_curve_to_dead_weights
from service.server import weighing, weighings
from service.server.weighing import Begin, MarkerChange, Withdraw
from service.sessions.calibration_file import parse_calibration, write_calibration
from storage.sessions.reader import SealedFileReader
from tests.service.cli.outcome import Run, scene_text, static_only
from tests.service.fake_node import FakeNode, Play
from tests.service.running import Running

pytestmark = pytest.mark.slow
GRAMS = (200.0, 500.0, 1000.0, 1500.0, 2000.0)
OTHERS_G = (300.0, 800.0, 1400.0)
FIVE = "200g,500g,1kg,1.5kg,2kg"


def put_on(path: Path, grams: tuple[float, ...]) -> None:
    """Write a load that puts masses on the first tile: 8 s without, 9 s with each."""
    rows = ["time_s,cell1_n"]
    for number, each in enumerate(grams):
        begin_s, force_n = 17.0 * number, 1e-3 * each * STANDARD_GRAVITY_M_S2
        rows += [f"{begin_s},0", f"{begin_s + 8},0", f"{begin_s + 8.4},{force_n}"]
        rows.append(f"{begin_s + 16.6},{force_n}")
    path.write_text("\n".join([*rows, f"{17.0 * len(grams)},0", ""]))


def follow(path: Path, weights: tuple[str, ...]) -> Indentation:
    """Return tile T01 of a recording, with the steps that the guide marks in it."""
    with SealedFileReader(path) as session:
        frames = [frames for frames, _ in session.read_batches()]
        compensation = Compensation(session.info.tiles)
    t_ns = np.concatenate([piece.t_ns for piece in frames])
    kpa = np.concatenate([compensation.compute_usable_kpa(piece)[:, 0] for piece in frames])
    guide = weighing.Weighing("T01", weights)
    phase = np.full(len(t_ns), "", dtype="<U20")
    begins: list[int] = []
    for begin in range(0, len(t_ns), 10):
        rows = slice(begin, begin + 10)
        for action in guide.feed_tile_pressures(t_ns[rows], kpa[rows]):
            match action:
                case Begin(label, _):
                    phase[begin:] = label.removeprefix("T01 ")
                    begins.append(begin)
                case Withdraw():
                    phase[begins.pop() :] = ""
                case _:
                    phase[begin:] = ""
    assert guide.step == "done"
    return Indentation(
        chip=MPL115A2,
        serial="T01",
        where=str(path),
        t_ns=t_ns,
        kpa=kpa,
        reference_n=np.full(len(t_ns), np.nan),
        phase=phase,
        is_under_indenter=phase != "",
        temperature_raw=np.full(len(t_ns), np.nan),
    )


def test_another_load_lies_within_the_interval_that_five_weights_state(run: Run) -> None:
    Path("one.toml").write_text(static_only(scene_text("standing", 1)))
    for name, grams in (("five", GRAMS), ("others", OTHERS_G)):
        put_on(Path(f"{name}.csv"), grams)
        asked = ("--scene", "one.toml", "--load", f"{name}.csv", "--truth", "--no-estimates")
        assert run("simulate", *asked, "--out", f"{name}.parquet").code == 0
    weights = check_and_label_weights(FIVE.split(","), 0.5)
    tile = fit_curve_to_dead_weights([follow(Path("five.parquet"), weights)])
    made = Calibration(name="five", reference="weights", date="2026-11-25", tiles=(tile,))
    write_calibration(Path("five.json"), made)
    asked_for = ("--calibration", "five.json", "--out", "estimated.parquet")
    assert run("estimate", "others.parquet", *asked_for).code == 0
    names = ("force_n", "force_sigma_n", "true_force_n")
    with SealedFileReader(Path("estimated.parquet")) as session:
        pieces = list(session.read_quantities(*names))
    force_n, sigma_n, true_n = (
        np.concatenate([piece[name] for piece in pieces])[:, 0] for name in names
    )
    for mass_g in OTHERS_G:
        other_n = 1e-3 * mass_g * STANDARD_GRAVITY_M_S2
        rows = np.flatnonzero(np.abs(true_n - other_n) < 1e-3 * other_n)
        settled = rows[len(rows) // 2 :]
        error_n, half_n = (force_n - true_n)[settled], 1.96 * sigma_n[settled]
        assert (np.abs(error_n) <= half_n).mean() > 0.9, mass_g
        assert half_n.mean() < 0.25 * true_n[settled].mean(), mass_g


@pytest.mark.slow(parts=8)
def test_the_command_guides_through_the_weights_and_writes_the_calibration(
    run: Run, running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("REST_S", "HOLD_S"):
        monkeypatch.setattr(weighing, name, 2.5)  # a fit needs steps of 2 s or more

    class Followed(weighing.Weighing):
        """A guide with an operator who follows its prompts."""

        def feed_tile_pressures(
            self, t_ns: npt.NDArray[np.int64], tile_absolute_kpa: Floats
        ) -> list[MarkerChange]:
            # By now the prompt is there, and the markers before it are made.
            known = parse_weight(self.weights[self.weight_index]) if self.step == "put on" else None
            if known is not None:
                play.force_n = known.force_n
            elif self.step == "empty":
                play.force_n = 0.0
            return super().feed_tile_pressures(t_ns, tile_absolute_kpa)

    monkeypatch.setattr(weighings, "Weighing", Followed)
    monkeypatch.setenv("FOOTTILE_TOKEN", tared.running.shown["Authorization"].split()[-1])
    asked: tuple[Any, ...] = ("--tile", "T01", "--weights", "10N,20N,40N,60N,80N")
    with Play(tared, alive=True) as play:
        outcome = run(
            *("calibrate", "--live", *asked, "--out", "cal.json", "--yes"),
            *("--server", running.url),
        )
    assert outcome.code == 0, outcome.err
    found = parse_calibration(Path("cal.json").read_bytes(), where="cal.json")
    facts = found.tiles[0].weights
    assert facts is not None
    assert [step.force_n for step in facts.steps] == [10.0, 20.0, 40.0, 60.0, 80.0]
    assert facts.band_95[-1].force_n == pytest.approx(80.0, abs=1.0)  # a count
    assert "80 N" in outcome.out
    (session,) = running.http.get("/sessions").json()["items"]
    assert session["id"] in outcome.err


def test_a_calibration_that_a_node_cannot_use_is_refused_before_the_weights(
    run: Run, running: Running, tared: FakeNode
) -> None:
    where = ("--out", "cal.json", "--server", running.url)
    run("calibrate", "--live", "--tile", "T77", *where).fails(2, "no tile T77")
    refused = run("calibrate", "--live", "--tile", "T01", "--assign", *where)
    refused.fails(2, "--assign without tile T02")

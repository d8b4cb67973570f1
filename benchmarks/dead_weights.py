"""How honest and how wide the interval of a tile is that was calibrated with dead weights.

`python benchmarks/dead_weights.py` puts weights on emulated domes, fits each dome from what a chip
would have read, puts other weights on it, and counts how often their force lies in the 95 %
interval that the calibration states. Domes creep, have loops, and differ from loading to loading as
in the paper. Which weights are put on, and when they are looked at, is drawn for each test.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.chips.mpl115a2 import MPL115A2
from devices.emulation.dome_physics import Domes
from devices.emulation.parts import draw_family_dome
from devices.emulation.surroundings import Surroundings
from devices.errors import CalibrationError
from devices.scene.emulation_sections import PartFamily
from service.estimation.dead_weights import STANDARD_GRAVITY_M_S2
from service.estimation.fitting.rig.indentation import Indentation
from service.estimation.fitting.weights_fit import fit_curve_to_dead_weights
from service.estimation.models.static import StaticParams, compute_forces
from service.offline.calibration_lookup import make_rig_scene

FIVE_G = (200.0, 500.0, 1000.0, 1500.0, 2000.0)
REST_S, HOLD_S, HANDS_S = 4.0, 6.0, 1.0
"""The hands take a second between putting a weight on and saying so."""
STEP_S = REST_S + HANDS_S + HOLD_S + HANDS_S
RATE_HZ = 20.0
NOISE_KPA = 0.15  # of a reading of the chip


@dataclass(frozen=True)
class Outcome:
    """What came of many domes: which test loads lay within, and how wide the intervals were."""

    is_within: np.ndarray
    relative_half_width: Floats
    relative_error: Floats
    refused: int
    """Domes that were refused, as the command would."""


class _Weights:
    """One weight after another on every dome, (steps, domes), in newtons."""

    def __init__(self, forces_n: Floats) -> None:
        self._forces_n = forces_n

    def forces_n(self, t_s: Floats) -> Floats:
        """Put on within 0.3 s, taken off within 0.2 s."""
        step = np.minimum((t_s // STEP_S).astype(int), len(self._forces_n) - 1)
        since = t_s - step * STEP_S
        there = np.clip((since - REST_S) / 0.3, 0.0, 1.0) * np.clip(
            (STEP_S - since) / 0.2, 0.0, 1.0
        )
        return np.asarray(self._forces_n[step] * there[:, None])


def measure(
    weights_g: Sequence[float], *, domes: int, tests: int, family: PartFamily, seed: int
) -> Outcome:
    """Calibrate emulated domes with these weights, and test each with loads that are drawn."""
    rng = np.random.default_rng(seed)
    scene = make_rig_scene("T01", family, 0.03).emulation
    serials = [f"W{seed}-{i}" for i in range(domes)]
    parts = [draw_family_dome(family, serial, seed) for serial in serials]
    known_n = 1e-3 * STANDARD_GRAVITY_M_S2 * np.array(weights_g)
    scale = 1.0 + rng.uniform(-0.005, 0.005, domes)  # what each scale is off by
    test_n = rng.uniform(0.1, 0.95, (tests, domes)) * known_n.max()
    forces_n = np.concatenate([known_n[:, None] * scale, test_n])
    emulated = Domes(
        parts, serials, _Weights(forces_n), scene, Surroundings(scene), label=f"weights/{seed}"
    )
    t_s = np.arange(len(forces_n) * STEP_S * RATE_HZ) / RATE_HZ
    kpa = np.array(
        [[emulated.compute_pressure_kpa(i, t) for i in range(domes)] for t in t_s.tolist()]
    )
    kpa += NOISE_KPA * rng.standard_normal(kpa.shape)
    step, since = np.divmod(t_s, STEP_S)
    in_rest = since < REST_S
    in_hold = (since >= REST_S + HANDS_S) & (since < STEP_S - HANDS_S)
    texts = [f"{grams:g} g +-0.5 %" for grams in weights_g]
    phase = np.array(
        ["rest" if k >= len(texts) or not holds else texts[k] for k, holds in
         zip(step.astype(int).tolist(), in_hold.tolist(), strict=True)]
    )  # fmt: skip
    calibrating = step < len(texts)
    within, widths, errors, refused = [], [], [], 0
    for i in range(domes):
        recording = Indentation(
            chip=MPL115A2,
            serial=serials[i],
            where="emulated",
            t_ns=np.round(t_s[calibrating] * 1e9).astype(np.int64),
            kpa=kpa[calibrating, i],
            reference_n=np.full(calibrating.sum(), np.nan),
            phase=phase[calibrating],
            is_under_indenter=(in_rest | in_hold)[calibrating],
            temperature_raw=np.full(calibrating.sum(), np.nan),
        )
        try:
            tile = fit_curve_to_dead_weights([recording])
        except CalibrationError:
            refused += 1
            continue
        for test in range(tests):
            now = step == len(texts) + test
            at_s = rng.uniform(REST_S + 1.0, STEP_S - HANDS_S - 0.5)
            tare_kpa = kpa[now & (since > REST_S - 1.0) & (since < REST_S), i].mean()
            gauge = kpa[now & (since >= at_s) & (since < at_s + 0.5), i].mean() - tare_kpa
            if gauge > tile.range_kpa[1]:
                continue  # an estimate says that it is a lower bound
            found = compute_forces(StaticParams.from_calibrations([tile]), np.array([[gauge]]))
            true_n = test_n[test, i]
            half_n = 1.96 * float(found.fit_sigma_n[0, 0])
            error_n = float(found.force_n[0, 0]) - true_n
            within.append(abs(error_n) <= half_n)
            widths.append(half_n / true_n)
            errors.append(error_n / true_n)
    return Outcome(np.array(within), np.array(widths), np.array(errors), refused)


def main() -> None:
    """Print a table, by weights and family."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--domes", type=int, default=150)
    parser.add_argument("--tests", type=int, default=4)
    asked = parser.parse_args()
    print("| weights | family | tests | within 95 % | half width, median | error, RMS | refused |")
    print("|---|---|---|---|---|---|---|")
    families: tuple[PartFamily, ...] = ("default", "broad")
    for weights_g, name in (
        (FIVE_G, "five, once"),
        (FIVE_G * 2, "five, twice"),
        (FIVE_G * 4, "five, four times"),
    ):
        for family in families:
            found = measure(
                weights_g, domes=asked.domes, tests=asked.tests, family=family, seed=len(weights_g)
            )
            print(
                f"| {name} | {family} | {len(found.is_within)} "
                f"| {100 * found.is_within.mean():.1f} % "
                f"| {100 * np.median(found.relative_half_width):.1f} % "
                f"| {100 * np.sqrt((found.relative_error**2).mean()):.1f} % "
                f"| {found.refused} of {asked.domes} |",
                flush=True,
            )


if __name__ == "__main__":
    main()

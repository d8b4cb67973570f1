"""What a calibrated tile should have read on the bench, beside what it did read.

For people: whether a model of gas and rubber is any good shows in a release and a tap at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from devices.arrays import Bools, Floats, Ints
from service.estimation.bench.effects_fit import curve_over_range, loadings
from service.estimation.bench.indentation import Indentation
from service.estimation.bench.model import DomeModel
from service.estimation.calibration import TileCalibration
from service.estimation.effects import values

_BEFORE_S = 0.02  # enough to see where it came from
_AFTER_S = 0.1  # in which the gas cools, and beyond which a hold is a hold


@dataclass(frozen=True)
class Replay:
    """A short time of a bench recording; arrays of m readings.

    Attributes:
        t_s: from the instant at which the force changes fastest.
        measured_kpa: gauge pressure, NaN where there is none.
        static_kpa: of the curve alone.
        modelled_kpa: of the curve with all effects that were determined, with the loading's gain.
    """

    t_s: Floats
    measured_kpa: Floats
    static_kpa: Floats
    modelled_kpa: Floats


def replays(recordings: Sequence[Indentation], tile: TileCalibration) -> dict[str, Replay]:
    """A "release" and a "tap" of the tile, as far as it was released and tapped.

    Of several it is the second, so that the first one's settling does not show.
    """
    if not any(np.isin(recording.phase, ("release", "tap")).any() for recording in recordings):
        return {}
    points, baseline_kpa = loadings(recordings)
    effects = tile.effects
    gas, rubber, loop = effects.gas, effects.rubber, effects.hysteresis
    curve = curve_over_range(tile.coefficients if rubber is None else rubber.coefficients)
    # The slow strokes' mean curve has creep and loop in it already.
    static_curve = curve_over_range(tile.coefficients)

    static = DomeModel(static_curve, tile.range_kpa[1], baseline_kpa, effects.wall_per_kpa)
    model = replace(static, curve=curve)
    if gas is not None:
        model = replace(model, gamma=gas.gamma.value, tau_s=gas.tau_s.value)
    if rubber is not None:
        model = replace(model, part=values(rubber.part), creep_s=values(rubber.tau_s))
    if loop is not None:
        model = replace(model, loop=values(loop.part))
    static_kpa, modelled_kpa = (
        each.pressed(points.t_s, points.force_n)[:, 0] - baseline_kpa for each in (static, model)
    )
    measured_kpa = points.kpa - baseline_kpa
    found: dict[str, Replay] = {}
    for name, centre in _moments(points.t_s, points.force_n, points.loading, points.fast).items():
        here = points.loading == points.loading[centre]
        # Each loading has its own gain, about one, fitted to its own readings.
        usable = here & np.isfinite(measured_kpa)
        square = float((modelled_kpa[usable] ** 2).sum())
        product = float((modelled_kpa[usable] * measured_kpa[usable]).sum())
        gain = product / square if square > 0.0 else 1.0
        t_s = points.t_s - points.t_s[centre]
        rows = (t_s >= -_BEFORE_S) & (t_s <= _AFTER_S)
        found[name] = Replay(
            t_s[rows], measured_kpa[rows], static_kpa[rows], gain * modelled_kpa[rows]
        )
    return found


def _moments(t_s: Floats, force_n: Floats, loading: Ints, fast: Bools) -> dict[str, int]:
    """Where to look: the second of the loadings that were held, and of those that were not."""
    held: list[int] = []
    tapped: list[int] = []
    for number in np.unique(loading[fast]):
        rows = np.flatnonzero(loading == number)
        borne = rows[force_n[rows] > 0.5 * force_n[rows].max()]
        if len(borne) < 2:
            continue
        long = t_s[borne[-1]] - t_s[borne[0]] > _AFTER_S
        # The end of a hold, where the force begins to fall; the peak of a tap.
        (held if long else tapped).append(
            int(borne[-1]) if long else int(borne[np.argmax(force_n[borne])])
        )
    return {
        name: places[min(1, len(places) - 1)]
        for name, places in (("release", held), ("tap", tapped))
        if places
    }

"""All constants of an estimate as records, which compiled code reads; made from its plan."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from devices.arrays import Floats
from service.estimation.foot.geometry import rad_per_count
from service.estimation.ladder.plan import SIGMAS, EstimationPlan
from service.estimation.ladder.unseen import LAW as UNSEEN
from service.estimation.models import ambient, flow, gas, hysteresis, rubber, static, temperature
from service.estimation.models.denoise import AVERAGED_MAX
from service.estimation.records import Records, record_type, records
from service.estimation.watch import repeats
from service.estimation.watch.repeats import SHARES

SCENE = record_type(
    [
        # Which models are named; 0 or 1.
        ("unwrap", np.int64),
        ("temperature", np.int64),
        ("ambient", np.int64),
        ("gas", np.int64),
        ("skew", np.int64),
        ("denoise", np.int64),
        ("hysteresis", np.int64),
        ("flow", np.int64),
        ("rubber", np.int64),
        ("watched", np.int64),
        ("warms", np.int64),
        # Look-ahead.
        ("waits", np.int64),
        ("lag_ns", np.int64),
        ("look_ns", np.int64),
        ("gap_ns", np.int64),
        # What is known beforehand.
        ("tare_lost", np.int64),
        ("tare_ns", np.int64),
        ("assumed_scale", np.int64),
        # Contact and centre of pressure.
        ("on_n", np.float64),
        ("off_n", np.float64),
        ("min_ns", np.int64),
        ("cop_sigma_max_m", np.float64),
        ("grid", np.int64),
        # The servo, if there is one, and how it becomes an angle and a place.
        ("servo", np.int64),
        ("counts_per_turn", np.int64),
        ("zero_counts", np.float64),
        ("rad_per_count", np.float64),
        ("travel_m_per_rad", np.float64),
        ("bearing", np.int64),  # number of tiles that bear load
        ("bound_on_n", np.float64),  # a bound that tells contact: `on_n` as the foot bears it
        # Is it known which way the ground pushes tiles that are not upright, and which?
        ("sheared", np.int64),
        ("shear", np.float64),
        ("shear_sigma", np.float64),
        # Of `repeats.Limits`, and of the sum of all tiles as of each of them.
        ("by_repeats", np.int64, (SHARES + 1,)),
        ("by_twos", np.int64, (SHARES + 1,)),
        ("noise_left", np.float64, (AVERAGED_MAX + 1,)),
    ]
)
"""What holds for the whole foot, as in `EstimationPlan`."""

TILE = record_type(
    [
        ("bears", np.int64),
        *((name, np.float64) for name in ("a0", "b1", "b2", "c12")),  # the chip's coefficients
        ("baseline_kpa", np.float64),
        ("noise_kpa", np.float64),
        ("tare_counts", np.float64),
        ("end_kpa", np.float64),
        ("unloaded_kpa", np.float64),
        ("repeats", repeats.LAW),
        # From here on of a tile that bears load only.
        ("even", np.float64),
        ("warms_kpa", np.float64),
        ("baseline_variance", np.float64),
        ("late_ns", np.int64),
        ("late_sigma_s", np.float64),
        ("late_common_s", np.float64),
        ("chip_end_kpa", np.float64),
        ("low_kpa", np.float64),
        ("unseen", UNSEEN),
        ("gas_known", np.int64),
        ("gas_misfit", np.float64),
        ("rubber_misfit", np.float64),
        ("place_m", np.float64, (3,)),
        ("gain", np.float64),
        ("gain_sigma", np.float64),
        ("axis_rad", np.float64),
        ("tilted", np.float64),
        ("noise_left", np.float64, (AVERAGED_MAX + 1,)),
        ("grid", np.float64, (2,)),
        ("static", static.LAW),
        ("temperature", temperature.LAW),
        ("ambient", ambient.LAW),
        ("gas", gas.LAW),
        ("flow", flow.LAW),
        ("hysteresis", hysteresis.LAW),
        ("rubber", rubber.LAW),
    ]
)
"""What holds for a tile; of models that are not named zeros, which nobody reads."""


class Laws(NamedTuple):
    """Constants of one estimate.

    Attributes:
        scene: (1,), `SCENE`.
        tiles: (tiles,), `TILE`.
        hull: (k, 3), unit normals and offsets in m of the half-planes that the tiles lie in.
    """

    scene: Records
    tiles: Records
    hull: Floats


def make_laws(plan: EstimationPlan) -> Laws:
    """Constants of `plan`, whose fields they repeat."""
    normals, offsets_m = plan.hull
    return Laws(
        scene=_scene(plan),
        tiles=_tiles(plan),
        hull=np.ascontiguousarray(np.column_stack([normals, offsets_m])),
    )


def _scene(plan: EstimationPlan) -> Records:
    ladder, servo = plan.ladder, plan.info.servo
    scene = records(
        SCENE,
        1,
        unwrap=ladder.unwrap,
        skew=ladder.skew,
        denoise=ladder.denoise,
        watched=plan.watch is not None,
        warms=plan.watch is not None and plan.watch.kpa_per_count is not None,
        waits=plan.waits,
        # Without look-ahead the next frame is not there, and may be of the same instant.
        lag_ns=plan.lag_ns,
        look_ns=plan.look_ns,
        gap_ns=plan.gap_ns,
        tare_lost=plan.tare.is_lost,
        tare_ns=plan.tare.t_ns,
        assumed_scale=plan.assumed_scale,
        on_n=plan.contact.on_n,
        off_n=plan.contact.off_n,
        bound_on_n=plan.contact.on_n * plan.gain.max(),
        min_ns=plan.contact.min_ns,
        cop_sigma_max_m=plan.cop_sigma_max_m,
        grid=plan.grid is not None,
        bearing=len(plan.bearing),
        noise_left=plan.noise_left.mean(axis=0),
    )
    if plan.watch is not None:
        limits = plan.watch.most
        scene["by_repeats"], scene["by_twos"] = limits.by_repeats, limits.by_twos
    for name in ("temperature", "ambient", "gas", "hysteresis", "flow", "rubber"):
        scene[name] = getattr(ladder, name) is not None
    if plan.shear is not None:
        scene["sheared"] = 1
        scene["shear"], scene["shear_sigma"] = plan.shear.value, plan.shear.sigma
    if servo is not None:
        travel = servo.ankle_travel_m_per_rad
        scene["servo"] = 1
        scene["counts_per_turn"], scene["zero_counts"] = servo.counts_per_turn, servo.zero_counts
        scene["rad_per_count"] = rad_per_count(servo)
        scene["travel_m_per_rad"] = np.nan if travel is None else travel
    return scene


def _tiles(plan: EstimationPlan) -> Records:
    tare, ladder, watch, bearing = plan.tare, plan.ladder, plan.watch, plan.bearing
    tiles = records(
        TILE,
        len(plan.info.tiles),
        **vars(plan.compensation),
        baseline_kpa=tare.baseline_kpa,
        noise_kpa=tare.noise_kpa,
        tare_counts=tare.tadc_counts,
    )
    if watch is not None:
        tiles["end_kpa"], tiles["unloaded_kpa"] = watch.end_kpa, watch.unloaded_kpa
        tiles["repeats"] = watch.most.laws()
    own = {
        "bears": 1,
        "even": 0.0 if watch is None else watch.even,
        "warms_kpa": 0.0 if watch is None or watch.kpa_per_count is None else watch.kpa_per_count,
        "baseline_variance": plan.baseline_sigma_kpa**2,
        "late_ns": plan.late_ns,
        "late_sigma_s": plan.late_sigma_s,
        "late_common_s": plan.late_common_s,
        "chip_end_kpa": plan.chip_end_kpa,
        "low_kpa": ladder.curves.low_kpa - SIGMAS * plan.still_kpa,
        "unseen": plan.unseen.laws(),
        "gas_known": ladder.gas_known,
        "gas_misfit": ladder.gas_misfit,
        "rubber_misfit": ladder.rubber_misfit,
        "place_m": plan.bearing_m,
        "gain": plan.gain,
        "gain_sigma": plan.gain_sigma,
        "axis_rad": plan.axis_rad,
        "tilted": plan.tilted,
        "noise_left": plan.noise_left,
        "static": ladder.curves.laws(),
    }
    for name in ("temperature", "ambient", "gas", "flow", "hysteresis", "rubber"):
        model = getattr(ladder, name)
        if model is not None:
            own[name] = model.laws()
    if plan.grid is not None:
        own["grid"] = np.column_stack(plan.grid)
    for name, values in own.items():
        tiles[name][bearing] = values
    return tiles

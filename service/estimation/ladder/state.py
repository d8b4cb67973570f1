"""What an estimate remembers from frame to frame: of every tile, and of the whole foot."""

from __future__ import annotations

import numpy as np

from devices.frames import NOT_READ
from service.estimation.foot import contact
from service.estimation.models import ambient, flow, gas, hysteresis, rubber, skew, temperature
from service.estimation.records import Records, record_type, records
from service.estimation.watch import baseline, clip, repeats, warmth

DOME = record_type(
    [("flow", flow.STATE), ("hysteresis", hysteresis.STATE), ("rubber", rubber.STATE)]
)
"""What a dome remembers of forces."""

TILE = record_type(
    [
        ("tadc", np.int64),  # last temperature that was read; `NOT_READ`: none
        ("tadc_ns", np.int64),
        ("before_kpa", np.float64),  # as read in the frame before
        ("repeats", repeats.STATE),
        ("clip", clip.STATE),
        ("baseline", baseline.STATE),
        ("warmth", warmth.STATE),
        ("temperature", temperature.STATE),
        ("gas", gas.STATE),
        # Models that remember, after what is farthest from what was taken; if something was unseen.
        ("has_gas_else", np.int64),
        ("gas_else", gas.STATE),
        ("skew", skew.STATE),
        ("dome", DOME),
        ("has_dome_else", np.int64),
        ("dome_else", DOME),
        ("last_n", np.float64),  # force in the frame before, ...
        ("last_ns", np.int64),  # ... and its instant
        ("has_last", np.int64),
    ]
)

SCENE = record_type(
    [
        # Rows of the room: the first whose estimate is not given, the first that is only read, and
        # the one after the last.
        ("due", np.int64),
        ("read", np.int64),
        ("end", np.int64),
        ("newest_ns", np.int64),  # of the newest frame
        ("runs", np.int64),
        ("toggles", np.int64),  # how often tiles have been loaded and let go, for the watch
        ("ambient", ambient.STATE),
        ("contact", contact.STATE),
        ("is_contact", np.int64),  # contact in the last estimate
    ]
)


def at_rest(tiles: int) -> tuple[Records, Records]:
    """Before the first frame: of the whole foot, and of every tile."""
    scene = records(SCENE, 1, ambient=ambient.at_rest())
    dome = records(
        DOME,
        tiles,
        flow=flow.at_rest(tiles),
        hysteresis=hysteresis.at_rest(tiles),
        rubber=rubber.at_rest(tiles),
    )
    of_tiles = records(
        TILE,
        tiles,
        tadc=NOT_READ,
        before_kpa=np.nan,
        repeats=repeats.at_rest(tiles),
        clip=clip.at_rest(tiles),
        baseline=baseline.at_rest(tiles),
        warmth=warmth.at_rest(tiles),
        temperature=temperature.at_rest(tiles),
        gas=gas.at_rest(tiles),
        skew=skew.at_rest(tiles),
        dome=dome,
    )
    return scene, of_tiles

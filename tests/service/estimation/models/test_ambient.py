"""`ambient`: a bare tile measures the pressure around the foot."""

from __future__ import annotations

import numpy as np
import pytest

from devices.errors import UsageError
from service.estimation.models.ambient import AmbientState, low_pass_ambient_kpa
from tests.builders.arrays import array_at
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import newton_plan
from tests.builders.readings import through


def test_a_silent_bare_tile_keeps_its_pressure_for_a_fifth_of_a_second() -> None:
    t_ns = np.arange(300, dtype=np.int64) * 2_000_000
    kpa = np.where(np.arange(300) < 100, 1.0, np.nan)
    state = AmbientState.array(1)
    ambient_kpa = through(low_pass_ambient_kpa, None, state, kpa, t_ns)
    assert ambient_kpa[:200] == pytest.approx(1.0)
    assert np.isnan(ambient_kpa[200:]).all()
    later_kpa = through(low_pass_ambient_kpa, None, state, 2.0, t_ns[-1] + t_ns[1:10])
    assert np.isfinite(later_kpa).all(), "its next reading counts again"


def test_a_dome_transmits_ambient_pressure_as_its_wall_yields() -> None:
    # hardware.md 9: c p/(1 + c p), a ninth of it with 0.00124 per kPa at 100 kPa
    tiles = [newton_tile("T01", effects=make_effects())]
    bare = array_at([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)], references=[1])
    plan = newton_plan(bare, models=("static", "ambient"), tiles=tiles)
    found, yielded = plan.load_bearing_params["ambient"], 0.0013 * plan.tare.baseline_kpa[0]
    assert found["transmitted_fraction"] == pytest.approx([yielded / (1 + yielded)])
    assert found["relative_sigma"] == pytest.approx([0.0002 / 0.0013])
    with pytest.raises(UsageError, match="bare reference tile"):
        newton_plan(array_at([(0.0, 0.0, 0.0)]), models=("static", "ambient"), tiles=tiles)

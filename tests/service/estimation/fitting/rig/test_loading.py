"""Loadings of a tile on the rig, for the fit of fast effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from devices.chips.mpl115a2 import MPL115A2
from service.estimation.fitting.rig.indentation import Indentation
from service.estimation.fitting.rig.loading import extract_loading_points, join_loading_points

ZERO = (0.0, 0.1)  # of the reference, N; noise, kPa


def record_taps(n: int = 3, *, outlier_at: int | None = None) -> Indentation:
    """Record taps of 15 N and 6 kPa whose top is a single reading, and rest."""
    one_n = np.concatenate([np.zeros(40), [5.0, 10.0, 15.0, 10.0, 5.0]])
    force_n = np.tile(one_n, n)
    kpa = 100.0 + 0.4 * force_n
    if outlier_at is not None:
        kpa[outlier_at] -= 3.0
    return Indentation(
        chip=MPL115A2,
        serial="T01",
        where="taps.parquet",
        t_ns=np.arange(len(force_n), dtype=np.int64) * 3_000_000,
        kpa=kpa,
        reference_n=force_n,
        phase=np.where(force_n > 0.0, "tap", "rest"),
        is_under_indenter=np.ones(len(force_n), dtype=bool),
        temperature_raw=np.full(len(force_n), 500.0),
    )


def test_the_single_reading_at_the_top_of_a_tap_counts() -> None:
    points = extract_loading_points(record_taps(), *ZERO)
    assert np.isfinite(points.kpa[points.force_n == 15.0]).all()


def test_a_spike_without_a_force_is_left_out() -> None:
    points = extract_loading_points(
        record_taps(outlier_at=60), *ZERO
    )  # at rest between the first two taps
    assert np.flatnonzero(np.isnan(points.kpa)).tolist() == [60]


def test_joined_recordings_keep_their_loadings_apart_and_far_apart() -> None:
    one, other = (
        extract_loading_points(record_taps(3), *ZERO),
        extract_loading_points(record_taps(2), *ZERO),
    )
    both = join_loading_points([one, other])
    assert both.n_loadings == one.n_loadings + other.n_loadings == 5
    assert (np.diff(both.t_s) > 0.0).all()
    assert np.diff(both.t_s).max() >= 600.0
    assert both.loading[len(one.t_s)] == one.n_loadings
    np.testing.assert_array_equal(both.kpa, np.concatenate([one.kpa, other.kpa]))


def test_strokes_without_rests_are_separate_loadings() -> None:
    phase = np.repeat(["rest", "load", "unload", "load", "unload", "load", "hold"], 20)
    taps = record_taps(1)
    no_rests = replace(
        taps,
        t_ns=np.arange(len(phase), dtype=np.int64) * 3_000_000,
        kpa=np.full(len(phase), 100.0),
        reference_n=np.zeros(len(phase)),
        phase=phase,
        is_under_indenter=np.ones(len(phase), dtype=bool),
        temperature_raw=np.full(len(phase), 500.0),
    )
    points = extract_loading_points(no_rests, *ZERO)
    assert points.n_loadings == 3
    assert points.is_fast[points.loading == 2].all()
    assert not points.is_fast[points.loading < 2].any()


def test_readings_of_one_instant_are_one_point() -> None:
    taps = record_taps()
    coarse = extract_loading_points(replace(taps, t_ns=taps.t_ns // 12_000_000 * 12_000_000), *ZERO)
    assert (np.diff(coarse.t_s) > 0.0).all()
    assert coarse.force_n.max() > 5.0
    assert coarse.n_loadings == 3

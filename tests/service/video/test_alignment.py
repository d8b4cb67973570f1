"""Touchdowns of films against contacts of sessions, and alignments that contradict each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import FileFormatError
from service.video.alignment import (
    Instants,
    describe_contradiction,
    fit_alignment,
    match_contacts,
)
from service.video.contact import find_touchdowns
from service.video.methods import COMMON_PART
from storage.sessions.videos import DRIFT_SIGMA, Alignment
from tests.service.video.test_contact import SECONDS, draw_marker_height

SESSION_S = 60.0


def draw_steps(
    generator: np.random.Generator, missed: int, spurious: int
) -> tuple[Instants, Instants, float, float]:
    """Touchdowns and contacts of a walk that begins within both, and the film's true line."""
    steps_s = 5.0 + np.cumsum(generator.uniform(0.45, 0.75, 14))
    sigma_s = generator.uniform(1e-3, 6e-3, len(steps_s))
    contacts_s = steps_s + generator.normal(0.0, 2e-3, len(steps_s))
    offset_s, drift = generator.uniform(-3.0, 4.0), generator.normal(0.0, DRIFT_SIGMA)
    touchdowns_s = (steps_s - offset_s) / (1.0 + drift) + generator.normal(0.0, sigma_s)
    kept = np.sort(generator.permutation(len(steps_s))[missed:])
    others_s = generator.uniform(touchdowns_s[0], touchdowns_s[-1], spurious)
    film_s = np.concatenate([touchdowns_s[kept], others_s])
    order = np.argsort(film_s)
    film_sigma_s = np.concatenate([sigma_s[kept], np.full(spurious, 3e-3)])
    touchdowns = Instants(film_s[order], film_sigma_s[order], 25.0)
    contacts = Instants(contacts_s, np.full(len(steps_s), 2e-3), SESSION_S)
    return touchdowns, contacts, offset_s, drift


def align(touchdowns: Instants, contacts: Instants, common: float = 0.0) -> Alignment:
    film, contact = map(np.array, zip(*match_contacts(touchdowns, contacts), strict=True))
    sigma_s = np.hypot(touchdowns.sigma_s[film], contacts.sigma_s[contact])
    return fit_alignment(
        "contact",
        touchdowns.at_s[film],
        1e9 * contacts.at_s[contact],
        1e9 * sigma_s,
        begin_t_ns=0,
        common_ns=common * 1e9 * float(np.median(touchdowns.sigma_s[film])),
    )


@given(seed=st.integers(0, 2**32 - 1), missed=st.integers(0, 3), spurious=st.integers(0, 2))
def test_steps_are_matched_whatever_few_are_missed_or_wrong(
    seed: int, missed: int, spurious: int
) -> None:
    touchdowns, contacts, offset_s, drift = draw_steps(
        np.random.default_rng(seed), missed, spurious
    )
    found = align(touchdowns, contacts)
    at_s = np.array([10.0])
    off_ns = found.t_ns + found.to_session_ns(at_s)[0] - 1e9 * (offset_s + 10.0 * (1.0 + drift))
    assert abs(off_ns) < 6.0 * found.compute_sigma_ns(at_s)[0]
    assert found.pair_count >= 14 - missed - 2


def test_the_uncertainty_by_contact_is_that_of_many_walks() -> None:
    generator = np.random.default_rng(2)
    ratios, drifts = [], []
    for _ in range(100):
        touchdowns, contacts, offset_s, drift = draw_steps(generator, 1, 1)
        found = align(touchdowns, contacts)
        at_s = np.array([9.0])
        off_ns = found.t_ns + found.to_session_ns(at_s)[0] - 1e9 * (offset_s + 9.0 * (1.0 + drift))
        assert abs(off_ns) < 20e6, "one picture at 50 pictures/s"
        ratios.append(off_ns / found.compute_sigma_ns(at_s)[0])
        drifts.append((found.drift - drift) / found.sigma_drift)
    assert 0.90 <= np.mean(np.abs(ratios) < 1.96) <= 0.99
    assert 0.90 <= np.mean(np.abs(drifts) < 1.96) <= 0.99


def test_films_of_hops_are_aligned_within_a_picture_as_surely_as_they_say() -> None:
    generator = np.random.default_rng(12)
    ratios, off_pictures = [], []
    for draw in range(120):
        rate_hz = (30.0, 50.0, 240.0)[draw % 3]
        film_s, height_px, true_s = draw_marker_height(rate_hz, 0.3, generator)
        offset_s = generator.uniform(2.0, 20.0)
        # The session has hops before and after the film, too.
        others_s = np.cumsum(generator.uniform(0.45, 0.85, (2, 6)), axis=1)
        hops_s = np.concatenate([true_s[0] - others_s[0][::-1], true_s, true_s[-1] + others_s[1]])
        sigma_s = 2e-3
        contacts_s = offset_s + hops_s + generator.normal(0.0, sigma_s, len(hops_s))
        kept = contacts_s > 0
        contacts = Instants(contacts_s[kept], np.full(kept.sum(), sigma_s), SESSION_S)
        at_s, film_sigma_s = np.array(find_touchdowns(film_s, height_px)).T
        try:
            touchdowns = Instants(at_s, film_sigma_s, SECONDS)
            found = align(touchdowns, contacts, COMMON_PART)
        except FileFormatError:  # three hops of sixteen: another match is as likely
            continue
        middle_s = np.array([found.film_s])
        off_ns = found.t_ns - 1e9 * (offset_s + found.film_s)
        off_pictures.append(off_ns * 1e-9 * rate_hz)
        ratios.append(off_ns / found.compute_sigma_ns(middle_s)[0])
    assert len(ratios) > 100
    assert np.abs(off_pictures).max() < 1.0
    assert 0.90 <= np.mean(np.abs(ratios) < 1.96) <= 0.99


def test_equal_steps_need_a_film_of_all_of_them_or_a_hint() -> None:
    steps_s = 5.0 + 0.6 * np.arange(10.0)
    contacts = Instants(steps_s, np.full(10, 2e-3), SESSION_S)
    whole = Instants(steps_s - 2.0, np.full(10, 2e-3), 20.0)
    assert match_contacts(whole, contacts) == [(k, k) for k in range(10)]
    part = Instants(steps_s[3:7] - 6.5, np.full(4, 2e-3), 2.4)
    with pytest.raises(FileFormatError, match="agree in more than one way"):
        match_contacts(part, contacts)
    assert match_contacts(part, contacts, (6.3, 6.7))[0] == (0, 3)
    with pytest.raises(FileFormatError, match="do not agree"):
        match_contacts(Instants(np.array([0.1, 1.37, 1.93, 4.1]), np.full(4, 1e-3), 9.0), contacts)
    with pytest.raises(FileFormatError, match="0 touchdowns"):
        match_contacts(Instants(np.empty(0), np.empty(0), 9.0), contacts)


def test_steps_that_repeat_hide_whether_a_film_began_before_its_session() -> None:
    hops_s = np.array([2.041, 2.919, 3.801, 6.682, 7.56, 8.442])
    contacts = Instants(hops_s, np.full(6, 2e-3), 10.8)
    # It begins 4 s before the session, and shows three hops before and the first three of it.
    early = Instants(np.array([*(hops_s[:3] - 4.641), *hops_s[:3]]) + 4.0, np.full(6, 2e-3), 9.0)
    with pytest.raises(FileFormatError, match="agree in more than one way"):
        match_contacts(early, contacts)
    with pytest.raises(FileFormatError, match="agree in more than one way"):
        match_contacts(early, contacts, (-9.0, 1.0))
    assert match_contacts(early, contacts, (-6.0, -2.0)) == [(3, 0), (4, 1), (5, 2)]
    # Already if two of them agree.
    contacts = contacts._replace(at_s=hops_s[[0, 1, 3, 4]], sigma_s=np.full(4, 2e-3))
    early = early._replace(at_s=early.at_s[[0, 1, 3, 4]], sigma_s=np.full(4, 2e-3))
    with pytest.raises(FileFormatError, match="agree in more than one way"):
        match_contacts(early, contacts)


def test_touchdowns_outside_the_session_do_not_speak_for_a_match() -> None:
    touchdowns = Instants(np.array([0.775, 1.411, 1.996, 2.668]), np.full(4, 4e-3), 3.17)
    contacts_s = np.array([0.412, 1.007, 1.606, 2.205, 2.745, 3.32, 3.951])
    with pytest.raises(FileFormatError, match="agree in more than one way"):
        match_contacts(touchdowns, Instants(contacts_s, np.full(7, 2e-3), 4.42))


def test_chosen_touchdowns_need_not_be_all_of_the_film() -> None:
    hops_s = np.array([2.041, 2.919, 3.801, 6.682])
    contacts = Instants(hops_s, np.full(4, 2e-3), 10.8)
    one = Instants(hops_s[1:2] - 1.0, np.array([5e-3]), 8.0)
    near_s = (0.6, 1.4)
    with pytest.raises(FileFormatError, match="do not agree"):
        match_contacts(one, contacts, near_s)
    assert match_contacts(one._replace(is_complete=False), contacts, near_s) == [(0, 1)]


def test_an_error_that_all_pairs_share_does_not_average_out() -> None:
    film_s, t_ns, sigma_ns = np.arange(4.0), 1e9 * np.arange(4.0), np.full(4, 1e6)
    alone = fit_alignment("light", film_s, t_ns, sigma_ns, begin_t_ns=0)
    shared = fit_alignment("light", film_s, t_ns, sigma_ns, begin_t_ns=0, common_ns=2e6)
    assert alone.sigma_ns == pytest.approx(0.5e6)
    assert shared.sigma_ns == pytest.approx(math.hypot(0.5e6, 2e6))
    assert shared.drift == alone.drift
    assert shared.sigma_drift >= alone.sigma_drift  # those of one end may share it


def test_alignments_that_differ_beyond_their_uncertainties_are_described() -> None:
    film_s = np.arange(4.0)
    one = fit_alignment("light", film_s, 1e9 * film_s, np.full(4, 1e6), begin_t_ns=10**18)
    other = fit_alignment("hand", film_s, 1e9 * film_s + 3e8, np.full(4, 1e7), begin_t_ns=10**18)
    assert describe_contradiction(one, one) == ""
    assert "300.0 ms later by hand than by light" in describe_contradiction(one, other)
    assert "300.0 ms earlier by light than by hand" in describe_contradiction(other, one)


def test_a_pair_that_is_said_twice_counts_once() -> None:
    once = fit_alignment(
        "hand", np.array([0.0, 2.0, 5.0]), np.array([0, 2e9, 9e9]), np.full(3, 1e6), begin_t_ns=0
    )
    film_s, t_ns = np.array([0.0, 2.0, 5.0, 5.0, 5.0]), np.array([0, 2e9, 9e9, 9e9, 9e9])
    assert fit_alignment("hand", film_s, t_ns, np.full(5, 1e6), begin_t_ns=0) == once


def test_pairs_that_scatter_more_than_they_state_are_as_uncertain_as_they_scatter() -> None:
    generator = np.random.default_rng(5)
    film_s = np.linspace(0.0, 60.0, 200)
    ratios = []
    for _ in range(50):
        t_ns = 1e9 * film_s + generator.normal(0.0, 20e6, 200)
        found = fit_alignment("hand", film_s, t_ns, np.full(200, 10e6), begin_t_ns=0)
        ratios.append(found.t_ns - 1e9 * found.film_s)
        assert found.sigma_ns == pytest.approx(20e6 / math.sqrt(200), rel=0.25)
    assert np.std(ratios) == pytest.approx(20e6 / math.sqrt(200), rel=0.3)


def test_a_stated_capture_rate_may_be_off_by_a_thousandth() -> None:
    film_s = np.linspace(0.0, 10.0, 10)
    found = fit_alignment(
        "hand", film_s, 1e9 * film_s * 1.001, np.full(10, 1e5), begin_t_ns=0, drift_sigma=1e-3
    )
    assert found.pair_count == 10
    assert found.drift == pytest.approx(1e-3, rel=0.01)

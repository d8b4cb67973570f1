"""Gaps of the force in a format without unknown values: a line, or no row; never 0 in a stance."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import UsageError
from service.estimation import LONG_GAP_NS
from storage.formats.slice import FormatOptions, Slice
from storage.formats.writers.force_gaps import BRIDGED_NS
from storage.formats.writers.opensim import OPENSIM
from storage.schema import Array
from tests.builders.arrays import PERIOD_NS
from tests.storage.formats.walks import (
    LATE_NS,
    RATE_HZ,
    ROWS,
    STANCES,
    export_of_walk,
    saturated,
    two_feet,
    walk,
)
from tests.storage.formats.writers.unpacked import Unpacked

END = FormatOptions(long_gap="end")
MIDDLE = 250
"""A frame in the middle of the first stance."""


def without(*rows: slice) -> Array:
    """The frames that are left without these."""
    return np.delete(np.arange(ROWS), np.concatenate([np.arange(ROWS)[each] for each in rows]))


def not_sampled(*rows: slice) -> dict[str, object]:
    """A walk whose slots there were not sampled: numbers of frames follow on, time does not."""
    kept = without(*rows)
    columns = {name: values[kept] for name, values in walk().items()}
    return {"columns": columns, "times": {"t_mono_ns": PERIOD_NS * kept}}


def true_n() -> Array:
    columns = walk()
    return np.where(columns["contact"] == 1, columns["grf_n"], 0.0)


def test_the_limit_is_the_time_in_which_a_foot_cannot_leave_the_ground_unseen() -> None:
    assert BRIDGED_NS == LONG_GAP_NS


@pytest.mark.parametrize("kind", ["lost", "not sampled", "unknown"])
def test_a_short_gap_in_a_stance_is_a_listed_line(kind: str, tmp_path: Path) -> None:
    gap = slice(MIDDLE, MIDDLE + 24)  # 25 periods: 50 ms
    columns = walk()
    columns["grf_n"][gap] = np.nan
    columns["estimate_flags"][gap] |= 32
    export = {
        "lost": lambda: export_of_walk(keep=without(gap)),
        "not sampled": lambda: export_of_walk(**not_sampled(gap)),  # type: ignore[arg-type]
        "unknown": lambda: export_of_walk(columns),
    }[kind]()
    found = Unpacked(export, tmp_path)
    beside = [gap.start - 1, gap.stop]
    line_n = np.interp(np.arange(gap.start, gap.stop), beside, true_n()[beside])
    force_n = found.columns["ground_force_vy"]
    np.testing.assert_allclose(force_n[gap], line_n, atol=1e-6)
    np.testing.assert_allclose(force_n, true_n(), atol=0.5)
    (row,) = (each for each in found.filled if each["filled"] == "force")
    assert (row["rows"], row["from_s"]) == (24, pytest.approx(gap.start / RATE_HZ))
    assert row["because"] == (
        "GRF not known" if kind == "unknown" else "no frame: lost or not taken"
    )
    told = "1 gaps of the force are straight lines, the longest 50.0 ms"
    assert all(told in text for text in (found.head[-1], found.notes["GAPS"], *export.remarks))
    assert len(export.remarks) == 1


@pytest.mark.parametrize(
    "gap",
    [
        pytest.param(slice(MIDDLE, MIDDLE + 25), id="52 ms in a stance"),
        pytest.param(slice(96, 106), id="22 ms over a begin of contact"),
        pytest.param(slice(430, 460), id="62 ms in flight"),
    ],
)
def test_a_long_gap_is_refused_with_a_slice_that_has_none_or_ends_the_file(
    gap: slice, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=r"a gap of the force is too long for a line") as refused:
        Unpacked(export_of_walk(keep=without(gap)), tmp_path)
    edges = re.search(r"the longest from ([0-9.]+) s to ([0-9.]+) s", str(refused.value))
    assert edges
    part = Slice(float(edges[1]), float(edges[2]))
    whole = Unpacked(export_of_walk(keep=without(gap), part=part), tmp_path / "slice")
    assert len(whole.table) >= max(gap.start, ROWS - gap.stop) - 2
    export = export_of_walk(keep=without(gap), options=END)
    found = Unpacked(export, tmp_path / "end")
    assert len(found.table) == gap.start
    np.testing.assert_allclose(found.columns["ground_force_vy"], true_n()[: gap.start], atol=1e-6)
    told = f"the file ends at {(gap.start - 1) / RATE_HZ:.3f} s"
    assert told in found.head[-1]
    assert told in export.remarks[0]


@pytest.mark.parametrize(
    ("gap", "is_flight"),
    [(slice(97, 106), False), (slice(430, 454), True)],
    ids=["20 ms over a begin of contact", "50 ms in flight"],
)
def test_short_gaps_beside_flight_fall_to_0_and_flight_stays_0(
    gap: slice, is_flight: bool, tmp_path: Path
) -> None:
    found = Unpacked(export_of_walk(keep=without(gap)), tmp_path)
    force_n = found.columns["ground_force_vy"][gap]
    if is_flight:
        np.testing.assert_array_equal(force_n, 0.0)
    else:
        line_n = np.interp(np.arange(gap.start, gap.stop), [96, 106], [0.0, true_n()[106]])
        np.testing.assert_allclose(force_n, line_n, atol=1e-6)


def test_no_line_is_drawn_over_a_saturated_tile(tmp_path: Path) -> None:
    columns = saturated(walk(), slice(MIDDLE, MIDDLE + 3))
    with pytest.raises(
        UsageError, match=r"a gap of the force is too long for a line, the longest 0\.008 s"
    ):
        Unpacked(export_of_walk(columns), tmp_path)
    assert len(Unpacked(export_of_walk(columns, options=END), tmp_path).table) == MIDDLE


def test_rows_before_the_first_force_and_after_the_last_are_left_out(tmp_path: Path) -> None:
    columns = walk()
    for rows in (slice(0, 150), slice(950, ROWS)):
        columns["grf_n"][rows] = np.nan
        columns["contact"][rows] = 255
    export = export_of_walk(columns)
    found = Unpacked(export, tmp_path)
    np.testing.assert_allclose(found.columns["time"], np.arange(150, 950) / RATE_HZ, atol=1e-9)
    assert "rows from 0.300 s to 1.898 s of 1.998 s" in export.remarks[0]
    events = (next(tmp_path.glob("*_events.csv"))).read_text().splitlines()[1:]
    assert [round(float(line.split(",")[0]) * RATE_HZ) for line in events] == [400, 500, 900]


@settings(max_examples=30, deadline=None)
@given(gaps=st.lists(st.tuples(st.integers(2, 990), st.integers(1, 30)), max_size=12))
def test_no_row_of_a_stance_is_0_whatever_frames_are_missing(
    gaps: list[tuple[int, int]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    kept = without(*(slice(begin, begin + count) for begin, count in gaps), slice(0, 0))
    folder = tmp_path_factory.mktemp("gaps")
    try:
        found = Unpacked(export_of_walk(keep=kept, options=END), folder)
    except UsageError as error:
        assert "no centre of pressure" in str(error)  # noqa: PT017  # it ends in flight
        return
    rows = np.rint(found.columns["time"] * RATE_HZ).astype(int)
    force_n = found.columns["ground_force_vy"]
    inside = np.zeros(ROWS, dtype=bool)
    for begin, end in STANCES:
        inside[begin + 10 : end - 10] = True
    assert (force_n[inside[rows]] > 0.0).all()
    np.testing.assert_allclose(force_n, true_n()[rows], atol=3.5)


def test_the_point_of_a_stance_is_never_that_of_the_stance_before(tmp_path: Path) -> None:
    columns = walk()
    (_, end), (begin, _) = STANCES
    hidden = [slice(end - 40, end), slice(begin, begin + 40)]
    for rows in hidden:
        for name in ("cop_x_m", "cop_y_m"):
            columns[name][rows] = np.nan
        columns["estimate_flags"][rows] |= 16
    found = Unpacked(export_of_walk(columns), tmp_path)
    x_m = found.columns["ground_force_px"]
    last_m, first_m = columns["cop_x_m"][[end - 41, begin + 40]]
    assert abs(first_m - last_m) > 2e-3
    np.testing.assert_allclose(x_m[hidden[0]], last_m, atol=1e-6)
    np.testing.assert_allclose(x_m[hidden[1]], first_m, atol=1e-6)
    between = np.diff(x_m[end:begin])
    assert (np.abs(between - between[0]) < 2e-6).all(), "in flight it goes from one to the other"


def test_of_two_feet_rows_are_those_in_which_both_forces_are_known(tmp_path: Path) -> None:
    feet = two_feet()
    content = b"".join(OPENSIM.encode_together_on_server_clock(feet))
    found = Unpacked(content, tmp_path)
    late = round(LATE_NS * 1e-9 * RATE_HZ)
    np.testing.assert_allclose(found.columns["time"], np.arange(late, ROWS) / RATE_HZ, atol=1e-9)
    left_n, right_n = (found.columns[f"{node}_ground_force_vy"] for node in ("left", "right-2"))
    np.testing.assert_allclose(left_n, true_n()[late:], atol=1e-6)
    np.testing.assert_allclose(right_n, true_n()[:-late], atol=1e-6)
    assert "rows from 0.300 s to 1.998 s of 2.298 s" in feet[0].remarks[0]


def test_feet_that_were_never_recorded_together_are_refused(tmp_path: Path) -> None:
    left, right = two_feet(part=Slice(0.0, 0.2))
    with pytest.raises(UsageError, match="at no instant do all feet have a force"):
        Unpacked(b"".join(OPENSIM.encode_together_on_server_clock([left, right])), tmp_path)

"""Figures of a reproduction, one PNG each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from devices.arrays import Bools, Floats
from service.estimation.fitting.least_squares import (
    compute_curve_through_zero_n,
    compute_mean_curve_half_width_95_n,
)
from service.estimation.records import SIGMAS_95
from service.offline.compare.report import OUR_COLOUR, REFERENCE_COLOUR, plot_band, plot_tiles
from service.offline.figure_output import create_figure, render_png
from studies.reproduce import experiments as paper
from studies.reproduce.experiments import MUD, PRESSURE_PLATE, DomeResult
from studies.reproduce.result import ExperimentResult, Reproduction, TrialResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHOWN_MARGIN_S = 0.25
MIN_LIFTED_S = 0.3
"""Time without contact after which the foot counts as lifted."""
_BESIDE_KPA = 0.4
_MATERIALS = {"40": ("#56B4E9", "#0072B2", "#003B5C"), "60": ("#F5B889", "#D55E00", "#7A3600")}
_LINES_N = {False: "the paper's 1 N", True: "the paper's 1 N, on seeds"}
"""Label of the paper's limit, by whether the setup is mud, for which the paper states none."""
_MARKERS = {10.0: "o", 11.0: "s", 12.0: "^"}
_QUANTITIES = (("lag_s", "lag"), ("drift_ppm", "drift"), ("offset_n", "offset"), ("scale", "scale"))
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")


def draw_figures(reproduction: Reproduction) -> Mapping[str, bytes]:
    """Draw the figures of all measured experiments; return PNGs by file name.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    drawn = {}
    if reproduction.domes:
        drawn["domes.png"] = _draw_domes(reproduction.domes)
    for experiment in reproduction.experiments:
        of_cop = experiment.setup.instrument == PRESSURE_PLATE
        draw = _draw_rolling if of_cop else _draw_hops
        drawn[f"{experiment.setup.name}.png"] = draw(experiment)
    if reproduction.experiments:
        drawn["references.png"] = _draw_references(reproduction.experiments)
    return drawn


def _draw_domes(domes: Sequence[DomeResult]) -> bytes:
    figure = create_figure(9.6, 4.8)
    curves, shapes = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    for found in domes:
        tile, colour = found.indented_tile.tile, _colour(found)
        grid_kpa = np.linspace(0.0, min(tile.range_kpa[1], found.end_kpa), 120)
        force_n, half_n = (
            compute_curve_through_zero_n(tile, grid_kpa),
            compute_mean_curve_half_width_95_n(tile, grid_kpa),
        )
        plot_band(curves, grid_kpa, force_n, half_n, colour)
        curves.plot(grid_kpa, force_n, color=colour, linewidth=1.6, label=found.dome.name)
        blocks = found.indented_tile.strokes
        every = np.flatnonzero(blocks.gauge_kpa <= grid_kpa[-1])[::5]
        curves.plot(
            blocks.gauge_kpa[every],
            blocks.force_n[every],
            _MARKERS[found.dome.diameter_mm],
            color=colour,
            markersize=2.6,
            markeredgewidth=0,
        )
        shapes.plot(grid_kpa / grid_kpa[-1], force_n / force_n[-1], color=colour, linewidth=1.4)
        if found.expected_range.source == "paper":
            curves.errorbar(
                [found.end_kpa + _BESIDE_KPA],
                [np.mean(paper.DOME_RANGE_N)],
                yerr=[0.5 * np.ptp(paper.DOME_RANGE_N)],
                color="black",
                capsize=5,
                label=f"the paper's range of {found.dome.name}",
            )
    curves.set_xlabel("pressure above the unloaded one, kPa, up to the chip's 115")
    curves.set_ylabel("indentation force, N")
    curves.set_title("Six domes, four loadings each: cubics with 95 % bands", fontsize=9.5)
    curves.legend(fontsize=8, loc="upper left")
    curves.set_xlim(0.0, None)
    curves.set_ylim(0.0, None)
    output = np.linspace(0.0, 1.0, 100)
    shapes.plot(output, paper.compute_normalised_force(output), "--", color="black", linewidth=1.8)
    shapes.plot([], [], "--", color="black", label="the paper's equation 2")
    shapes.plot([], [], color="#666666", label="cubics of the six emulated domes")
    shapes.set_xlabel("output, part of its greatest")
    shapes.set_ylabel("force, part of full scale")
    shapes.set_title("Shapes alone: equation 2 has no units", fontsize=9.5)
    shapes.legend(fontsize=8, loc="upper left")
    shapes.set_xlim(0.0, 1.0)
    shapes.set_ylim(0.0, 1.0)
    for axis in (curves, shapes):
        axis.grid(alpha=0.25)
    return render_png(figure)


def _colour(found: DomeResult) -> str:
    shades = _MATERIALS[found.dome.material.name.split()[-1]]
    return shades[round(found.dome.diameter_mm) - 10]


def _draw_rolling(experiment: ExperimentResult) -> bytes:
    figure = create_figure(9.6, 7.6)
    force, place, error = figure.subplots(3, 1, height_ratios=(2.2, 1.8, 1.6), sharex=True)
    first = experiment.trials[0]
    pairs, rows = first.comparison.pairs, _select_first_roll(first)
    t_s = pairs.t_s[rows] - _find_first_contact_s(first)
    _draw_tiles(force, first, rows, t_s)
    for k, (name, colour) in enumerate((("x", OUR_COLOUR), ("y", "#009E73"))):
        ours_mm = 1e3 * pairs.columns[f"cop_{name}_m"][rows]
        if np.isnan(ours_mm).all():  # across a row of tiles
            continue
        half_mm = SIGMAS_95 * 1e3 * pairs.columns[f"cop_sigma_{name}_m"][rows]
        plot_band(place, t_s, ours_mm, half_mm, colour)
        along = "forward" if name == "x" else "to the left"
        place.plot(t_s, ours_mm, color=colour, linewidth=1.3, label=f"foot, {along}")
        theirs_mm = (
            1e3 * np.where(pairs.reference_contact, pairs.reference_cop_m[:, k], np.nan)[rows]
        )
        place.plot(t_s, theirs_mm, "--", color="black", linewidth=1.0)
    place.plot([], [], "--", color="black", label="pressure plate")
    place.set_ylabel("COP, mm")
    place.set_ylim(-28, 28)
    place.legend(fontsize=8, loc="upper left")
    error.axhspan(
        -1e3 * paper.MAX_COP_ERROR_M,
        1e3 * paper.MAX_COP_ERROR_M,
        color="#EEEEEE",
        label="the paper's 4 mm",
    )
    for number, one in enumerate(experiment.trials):
        off_mm, own_s = _compute_cop_error_x(one)
        error.plot(
            own_s,
            off_mm,
            color=_COLOURS[number % len(_COLOURS)],
            linewidth=0.9,
            label=f"run {number + 1}",
        )
    error.axhline(0.0, color="black", linewidth=0.6)
    error.set_ylim(-5.0, 5.0)
    error.set_ylabel("COP forward, foot\nless plate, mm")
    error.set_xlabel("time since contact, s")
    error.legend(fontsize=8, loc="lower right", ncols=5)
    for axis in (force, place, error):
        axis.grid(alpha=0.25)
        axis.set_xlim(t_s[0], t_s[-1])
    figure.suptitle(
        f"{experiment.setup.title}: {_describe_trials(experiment, 'run')}",
        fontsize=10.5,
    )
    figure.align_ylabels((force, place, error))
    return render_png(figure)


def _draw_tiles(axis: Axes, one: TrialResult, rows: Bools, t_s: Floats) -> None:
    found = one.comparison
    reference_n = found.pairs.reference_n[rows]
    plot_tiles(axis, t_s, found.tile_force_n[rows], found.serials, reference_n, "pressure plate")
    axis.axhline(paper.LEG_WEIGHT_N, color="#666666", linewidth=0.8)
    axis.annotate(
        "weight of the leg",
        (t_s[-1], paper.LEG_WEIGHT_N),
        (-4, 3),
        textcoords="offset points",
        ha="right",
        fontsize=8,
        color="#444444",
    )
    axis.set_ylim(0.0, 12.5)
    axis.legend(fontsize=8, loc="upper left", ncols=5)


def _draw_hops(experiment: ExperimentResult) -> bytes:
    figure = create_figure(9.6, 5.6)
    grid = figure.add_gridspec(2, 2, height_ratios=(2.2, 1.0), width_ratios=(5.0, 1.0))
    force, error = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    means = figure.add_subplot(grid[:, 1])
    first = experiment.trials[0]
    pairs, rows = first.comparison.pairs, _select_shown(first)
    t_s = pairs.t_s[rows] - _find_first_contact_s(first)
    ours_n = pairs.columns["grf_n"][rows]
    half_n = SIGMAS_95 * pairs.columns["grf_sigma_n"][rows]
    plot_band(force, t_s, ours_n, half_n, OUR_COLOUR, "its 95 %")
    force.plot(t_s, ours_n, color=OUR_COLOUR, linewidth=1.2, label="foot")
    force.plot(
        t_s, pairs.reference_n[rows], color=REFERENCE_COLOUR, linewidth=1.0, label="force plate"
    )
    force.set_ylabel("GRF, N")
    force.legend(fontsize=8, loc="upper center", ncols=3)
    force.tick_params(labelbottom=False)
    error.axhspan(
        -paper.MAX_GRF_ERROR_N,
        paper.MAX_GRF_ERROR_N,
        color="#EEEEEE",
        label=_LINES_N[experiment.setup is MUD],
    )
    plot_band(error, t_s, np.zeros(len(t_s)), half_n, OUR_COLOUR)
    error.plot(t_s, pairs.error_n[rows], color="black", linewidth=0.8)
    error.set_ylabel("foot less\nplate, N")
    error.set_xlabel("time since first contact, s")
    # The error while mud pulls at the foot would dominate the scale.
    loaded = rows & pairs.reference_contact
    edge_n = max(2.5, 1.2 * float(np.nanpercentile(np.abs(pairs.error_n[loaded]), 98.0)))
    error.set_ylim(-edge_n, edge_n)
    error.legend(fontsize=8, loc="lower right")
    force.set_ylim(top=1.2 * float(np.nanmax(pairs.reference_n[rows])))
    for axis in (force, error):
        axis.grid(alpha=0.25)
        axis.set_xlim(t_s[0], t_s[-1])
    _draw_means(means, experiment)
    figure.suptitle(
        f"{experiment.setup.title}: {_describe_trials(experiment, 'trial')}",
        fontsize=10.5,
    )
    figure.align_ylabels((force, error))
    return render_png(figure)


def _draw_means(axis: Axes, experiment: ExperimentResult) -> None:
    each_n = [one.figures["grf_mae_n"] for one in experiment.trials]
    over = experiment.figures["grf_mae_n"]
    axis.axhspan(0.0, paper.MAX_GRF_ERROR_N, color="#EEEEEE")
    axis.plot(np.zeros(len(each_n)) - 0.12, each_n, "o", color=OUR_COLOUR, markersize=4, alpha=0.8)
    if over.interval_95 is not None:
        low_n, high_n = over.interval_95
        axis.errorbar(
            [0.12],
            [over.mean],
            [[over.mean - low_n], [high_n - over.mean]],
            fmt="s",
            color="black",
            markersize=4,
            capsize=4,
        )
    axis.set_xlim(-0.5, 0.5)
    axis.set_ylim(0.0, 1.15 * max(1.0, *each_n))
    axis.set_xticks([-0.12, 0.12], ["trials", "mean"], fontsize=8)
    axis.set_title("mean absolute\nerror, N", fontsize=9)
    axis.grid(alpha=0.25, axis="y")


def _draw_references(experiments: Sequence[ExperimentResult]) -> bytes:
    """Draw the difference of found and injected properties of each reference."""
    judged = [(e, one) for e in experiments for one in e.trials]
    figure = create_figure(9.6, 1.9 + 0.22 * len(judged))
    axes = figure.subplots(1, len(_QUANTITIES), sharey=True)
    for axis, (name, label) in zip(axes, _QUANTITIES, strict=True):
        in_intervals = name != "scale"
        if in_intervals:
            axis.axvspan(-1.0, 1.0, color="#EEEEEE")
        axis.axvline(0.0, color="black", linewidth=0.8)
        for row, (experiment, one) in enumerate(judged):
            check = one.checks[name]
            if check.found is None:
                continue
            colour = _COLOURS[experiments.index(experiment) % len(_COLOURS)]
            if in_intervals:
                axis.plot([check.error_in_half_intervals], [-row], "o", color=colour, markersize=5)
                continue
            low, high = check.found.interval_95
            at, half = 100.0 * (check.found.value - check.injected), 50.0 * (high - low)
            axis.errorbar([at], [-row], xerr=[half], fmt="o", color=colour, markersize=5)
        if in_intervals:
            reach = max(2.0, *(abs(one.checks[name].error_in_half_intervals) for _, one in judged))
            axis.set_xlim(-1.1 * reach, 1.1 * reach)
        axis.set_title(label, fontsize=9.5)
        axis.set_xlabel("in half 95 % intervals" if in_intervals else "per cent, with interval")
        axis.grid(alpha=0.25, axis="x")
    axes[0].set_yticks(-np.arange(len(judged)), [one.name for _, one in judged], fontsize=8)
    figure.suptitle("What was found of the references, less what was injected", fontsize=10.5)
    return render_png(figure)


def _compute_cop_error_x(one: TrialResult) -> tuple[Floats, Floats]:
    pairs = one.comparison.pairs
    rows = (
        _select_first_roll(one)
        & pairs.reference_contact
        & (pairs.columns["contact"] == 1)
        & pairs.is_counted
    )
    off_m = pairs.columns["cop_x_m"][rows] - pairs.reference_cop_m[rows, 0]
    return np.asarray(1e3 * off_m), np.asarray(pairs.t_s[rows] - _find_first_contact_s(one))


def _find_first_contact_s(one: TrialResult) -> float:
    """Return the time of the first common contact."""
    pairs = one.comparison.pairs
    both = np.flatnonzero(pairs.reference_contact & (pairs.columns["contact"] == 1))
    return float(pairs.t_s[both[0]]) if len(both) else float(pairs.t_s[0])


def _select_shown(one: TrialResult) -> Bools:
    """Select the frames from shortly before the first contact until shortly after the last."""
    pairs = one.comparison.pairs
    touched_s = pairs.t_s[pairs.reference_contact]
    end_s = float(touched_s[-1]) if len(touched_s) else float(pairs.t_s[-1])
    return _select_until(one, end_s)


def _select_first_roll(one: TrialResult) -> Bools:
    """Select the frames from shortly before the first contact until shortly after lifting."""
    pairs, begin_s = one.comparison.pairs, _find_first_contact_s(one)
    touched_s = pairs.t_s[pairs.reference_contact & (pairs.t_s >= begin_s)]
    lifted = np.flatnonzero(np.diff(touched_s) > MIN_LIFTED_S)
    return _select_until(one, float(touched_s[lifted[0] if len(lifted) else -1]))


def _select_until(one: TrialResult, end_s: float) -> Bools:
    t_s = one.comparison.pairs.t_s
    return np.asarray(
        (t_s >= _find_first_contact_s(one) - SHOWN_MARGIN_S) & (t_s <= end_s + SHOWN_MARGIN_S)
    )


def _describe_trials(experiment: ExperimentResult, what: str) -> str:
    trials = len(experiment.trials)
    return f"one {what}" if trials == 1 else f"{trials} {what}s, the first one in full"

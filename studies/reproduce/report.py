"""Markdown report of a reproduction: table of paper and ours, then each experiment."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from studies.reproduce import experiments as paper
from studies.reproduce.experiments import MUD, POPPY, POPPY_RIM, ROLLING
from studies.reproduce.result import (
    REPORTED_FIGURES,
    ExperimentResult,
    InjectedValueCheck,
    Reproduction,
    TrialResult,
)

ONE_FOOT = (
    "One foot is real and the other emulated: the paper's errors are those of cast domes on a "
    "robot, ours those of a model of them, which knows no more than is published. What stands "
    "here says that the whole product, from bus to comparison, loses little of what such a foot "
    "could give; it says nothing of how good a real foot is."
)
_CHECKED_PROPERTIES: tuple[tuple[str, str, float, int], ...] = (
    ("lag_s", "the lag", 1e3, 2),
    ("drift_ppm", "the drift", 1.0, 0),
    ("offset_n", "the offset", 1.0, 3),
    ("scale", "the scale", 1.0, 3),
)
"""Checked properties of a reference: field, title, display factor, digits."""
_MM = ("cop_mean_m", "cop_p95_m", "cop_p95_about_mean_m")
_HEADS = {
    "grf_mae_n": "GRF mean absolute error, N",
    "grf_bias_n": "GRF mean error, N",
    "grf_rmse_n": "GRF root mean square error, N",
    "grf_coverage_95": "GRF within the 95 % interval, %",
    "peak_mae_n": "peak of a stance, N",
    "impulse_mae_n_s": "impulse of a stance, N s",
    "cop_mean_m": "COP mean distance, mm",
    "cop_p95_m": "COP 95th percentile, mm",
    "cop_p95_about_mean_m": "the same about its mean error, mm",
    "cop_coverage_x_95": "COP forward within the 95 % interval, %",
}


def format_reproduction_report(result: Reproduction) -> str:
    """Format the report; figures are separate files."""
    lines = [
        "# The paper, end to end",
        "",
        f"{result.software}, {result.run_at}, seed {result.seed}"
        + (", a quick look only" if result.is_shortened else "")
        + f"; {_describe_run_time(result)}.",
        "",
        f"PAPER: {paper.CITED}.",
        "",
        ONE_FOOT,
        "",
        *(f"- {note}" for note in result.notes),
        *([""] if result.notes else []),
        *_format_comparison_table(result),
        *_format_domes(result),
        *(line for one in result.experiments for line in _format_experiment(result, one)),
        *_format_angles(result),
        *_format_references(result),
        *_format_failures(result),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _describe_run_time(result: Reproduction) -> str:
    parts = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in result.seconds.items())
    return f"it took {sum(result.seconds.values()):.0f} s ({parts})"


def _format_comparison_table(result: Reproduction) -> Iterator[str]:
    """Yield the table of the paper's and our values."""
    yield from ("## The paper beside this", "", "| | paper | here |", "|---|---|---|")
    rows = [*_list_dome_rows(result)] if result.domes else []
    if (rolling := result.find_experiment(ROLLING.name)) is not None:
        rows.append(("rolling: COP error, mm", "below 4 (III)", _describe_cop(rolling)))
    for setup in (ROLLING, POPPY, POPPY_RIM, MUD):
        if (one := result.find_experiment(setup.name)) is None:
            continue
        stated = "below 1 (III)" if setup is not MUD else "no number known here"
        rows.append(
            (
                f"{setup.title[0].lower()}{setup.title[1:]}: GRF mean error, N",
                stated,
                _format_figure(one, "grf_mae_n"),
            )
        )
    rates = [one.rate_hz for experiment in result.experiments for one in experiment.trials]
    if rates:
        rows.append(
            (
                "frames a second, four tiles",
                f"{paper.FRAME_RATE_HZ:.0f} (II-C)",
                f"{min(rates):.0f} to {max(rates):.0f}, emulated in real time on this machine",
            )
        )
    yield from (f"| {what} | {theirs} | {ours} |" for what, theirs, ours in rows)
    yield from (
        "",
        "Intervals are 95 % over trials, Student's. A mean error here is the mean absolute one, "
        "of frames under load; whether the paper's is, too, is not known here.",
        "",
    )


def _list_dome_rows(result: Reproduction) -> Iterator[tuple[str, str, str]]:
    """Yield the rows of the domes: figure, the paper's value, ours."""
    tiles = [one.indented_tile.tile for one in result.domes]
    means = [tile.rig.r2_of_mean for tile in tiles if tile.rig]
    each = [tile.r2 for tile in tiles if tile.r2 is not None]
    yield "R² of the cubic, mean over loadings", "99.99 % (eq. 2)", _format_span(means)
    yield "R² of the same cubic, every loading", "not known here", _format_span(each)
    if (spread := result.repeatability) is not None:
        value, (low, high) = spread
        yield (
            "standard deviation between loadings, normalised",
            f"{paper.REPEATABILITY} (III-A)",
            f"{value:.3f} ({low:.3f} to {high:.3f}); emulated with 0.03",
        )
    for one in result.domes:
        if one.expected_range.source == "paper":
            yield (
                f"range of {one.dome.name}, N",
                f"{paper.DOME_RANGE_N[0]:.0f} to {paper.DOME_RANGE_N[1]:.0f} (III-A)",
                f"{one.full_scale_n[0]:.1f} ± {one.full_scale_n[1]:.1f}",
            )


def _format_domes(result: Reproduction) -> Iterator[str]:
    if not result.domes:
        return
    yield from (
        "## Table I: six indented domes",
        "",
        "Two polyurethanes, three diameters, pressed four times each past the chip's 115 kPa, in "
        "virtual time, and fitted as `foottile calibrate` does. The paper states a range for 11 "
        "mm of Vytaflex 60 only; the emulated others are its dome with forces scaled by modulus "
        "and area, as `foottile domes` estimates them, all of one casting. So what this shows of "
        "them is that the indenter finds what is there, and no more. The paper's figure of the "
        "curves (Fig. 5) is known here by a sentence: stiffer and larger domes shift it to higher "
        "force.",
        "",
        "![Force over pressure of six domes, and their shapes beside equation 2](domes.png)",
        "",
        "| dome | MPa | full scale, N | expected, N | R² of the mean | R² of all | "
        "between loadings |",
        "|---|--:|--:|--:|--:|--:|--:|",
    )
    for one in result.domes:
        tile, (full_n, half_n) = one.indented_tile.tile, one.full_scale_n
        low_n, high_n = one.expected_range.low_n, one.expected_range.high_n
        basis = "" if one.expected_range.source == "paper" else " (scaled)"
        mean = tile.rig.r2_of_mean if tile.rig is not None else math.nan
        yield (
            f"| {one.dome.name} | {one.dome.material.modulus_mpa} | {full_n:.1f} ± {half_n:.1f}"
            f"{'' if one.is_full_scale_reached else ', drawn out'} | "
            f"{low_n:.1f} to {high_n:.1f}{basis} | {100 * mean:.2f} % | "
            f"{100 * (tile.r2 or math.nan):.2f} % | {one.repeatability:.3f} |"
        )
    yield from (
        "",
        "Equation 2 has no units (docs/hardware.md 7), so only its shape is compared: force over "
        "output, both in parts of their greatest.",
        "",
    )


def _format_experiment(result: Reproduction, one: ExperimentResult) -> Iterator[str]:
    setup = one.setup
    yield from (f"## {setup.title}", "", *_EXPERIMENT_TEXTS.get(setup.name, ()), "")
    yield from (f"![{setup.title}: foot and {setup.instrument}]({setup.name}.png)", "")
    names = [name for name in REPORTED_FIGURES if math.isfinite(one.figures[name].mean)]
    yield "| figure | mean over trials | " + " | ".join(t.name for t in one.trials) + " |"
    yield "|---|--:|" + "--:|" * len(one.trials)
    for name in names:
        each = (_number(name, trial.figures[name]) for trial in one.trials)
        yield f"| {_HEADS[name]} | {_format_figure(one, name)} | " + " | ".join(each) + " |"
    lost, missed = (
        sum(getattr(t, name) for t in one.trials) for name in ("lost_frames", "missed_slots")
    )
    frames = sum(trial.frames for trial in one.trials)
    yield from ("", f"{frames} frames, {lost} lost; {missed} slots were missed.")
    if (rest_n := result.not_borne_n.get(setup.name)) is not None and rest_n > 0.0:
        yield (
            f"While the plate is loaded it sees {rest_n:.2f} N in the mean that no dome bears. "
            "That is known because all is emulated, and in every error above."
        )
    yield ""


_EXPERIMENT_TEXTS = {
    ROLLING.name: (
        "The foot's arc rolls over a plate under the leg's weight; a pressure plate sees its "
        "footprint. The paper's sentence: the COP's error is below 4 mm. Where the foot stands on "
        "the plate is known to half a millimetre and a degree, as if it had been put on a marker, "
        "so distances have that in them, but for those about their mean.",
    ),
    POPPY.name: (
        "The leg is dropped from 10 cm and hops three times; a force plate lies under the seeds. "
        "The paper's sentence: the mean error is below 1 N. Here the sole is all domes, since a "
        "plate sees the whole foot: what else bears load is no error of the domes.",
    ),
    POPPY_RIM.name: (
        "The same, with the sole as the scene `poppy` has it: a fifth of its area is a rim on no "
        "dome. The plate sees the rim, too; the comparison says so with its scale.",
    ),
    MUD.name: (
        "The same hops in cold mud. Of the paper it is known here that its tiles were shown to "
        "work in liquid mud, and no number of that. Mud pulls at the foot when it leaves, bears "
        "it up and drags at it; the plate sees that and the domes do not.",
    ),
}


def _format_angles(result: Reproduction) -> Iterator[str]:
    found = result.angles
    if found is None:
        return
    yield from (
        "## Angle from video",
        "",
        f"The paper takes the angle from a film at 50 frames/s. Here two tags along the leg are "
        f"rendered as {found.pictures} pictures at {found.rate_hz:g} a second, and tracked.",
        "",
        "| angle by | its error, degrees: RMS, greatest | COP forward on the ground, mm RMS |",
        "|---|--:|--:|",
    )
    for source, rms_rad in found.angle_rms_rad.items():
        most_rad = found.angle_most_rad[source]
        yield (
            f"| {source} | {math.degrees(rms_rad):.3f}, {math.degrees(most_rad):.3f} "
            f"| {1e3 * found.cop_rms_m[source]:.4f} |"
        )
    yield from (
        "",
        f"The COP differs by {1e3 * found.cop_apart_m:.4f} mm at most. A foot that rolls without "
        "slip touches the ground below its ankle whatever its angle (eq. 3), so the angle's error "
        "moves the COP little.",
        "",
    )


def _format_references(result: Reproduction) -> Iterator[str]:
    judged = [trial for one in result.experiments for trial in one.trials]
    if not judged:
        return
    yield from (
        "## Did the comparison find what was injected?",
        "",
        "Each plate starts late, by a clock that drifts, with an offset and a gain of its own "
        "(docs/hardware.md 11). The comparison has the plate's file and its stated accuracy and "
        "nothing else.",
        "",
        "![Found less injected, with intervals](references.png)",
        "",
        "| trial | lag, ms: found (injected) | drift, ppm | offset, N | scale |",
        "|---|--:|--:|--:|--:|",
    )
    for one in judged:
        cells = (
            _format_check(one.checks[name], factor, digits)
            for name, _, factor, digits in _CHECKED_PROPERTIES
        )
        yield f"| {one.name} | " + " | ".join(cells) + " |"
    # The scale is comparable only if the plate measures no load beside that on the domes.
    same = [t for e in result.experiments if not result.not_borne_n[e.setup.name] for t in e.trials]
    counts = ", ".join(
        f"{words} in {_count_inside(same if name == 'scale' else judged, name)}"
        for name, words, *_ in _CHECKED_PROPERTIES
    )
    yield from (
        "",
        f"Within the 95 % interval: {counts} where the plate sees what domes bear and no more. The "
        "offset's is wider here by the plate's slow noise, which is no offset. In mud the plate "
        "feels drag before the domes bear load, which is worth one to two milliseconds and no lag "
        "of its clock. A drift is told from a few seconds, and so badly. The scale is not the "
        "plate's alone: it is one loading's gain of the foot, which differs by 3 % from loading to "
        "loading, over the plate's.",
        "",
    )


def _count_inside(judged: Sequence[TrialResult], name: str) -> str:
    return f"{sum(one.checks[name].is_inside_interval for one in judged)} of {len(judged)}"


def _format_check(check: InjectedValueCheck, factor: float, digits: int) -> str:
    if check.found is None:
        return f"- ({factor * check.injected:.{digits}f})"
    low, high = check.found.interval_95
    half = factor * (high - low) / 2.0
    value = factor * check.found.value
    return f"{value:.{digits}f} ± {half:.{digits}f} ({factor * check.injected:.{digits}f})"


def _format_failures(result: Reproduction) -> Iterator[str]:
    if result.failures:
        yield from ("## Not measured", "", *(f"- {k}: {v}" for k, v in result.failures.items()), "")


def _format_figure(one: ExperimentResult, name: str) -> str:
    over = one.figures[name]
    if over.interval_95 is None:
        return _number(name, over.mean)
    ends = over.interval_95
    if "coverage" in name:  # clip Student's interval to [0, 1]
        ends = max(ends[0], 0.0), min(ends[1], 1.0)
    low, high = (_number(name, end) for end in ends)
    return f"{_number(name, over.mean)} ({low} to {high})"


def _describe_cop(rolling: ExperimentResult) -> str:
    return (
        f"mean {_format_figure(rolling, 'cop_mean_m')}, "
        f"95th percentile {_format_figure(rolling, 'cop_p95_m')}; "
        f"without the mean error of placement {_format_figure(rolling, 'cop_p95_about_mean_m')}"
    )


def _number(name: str, value: float) -> str:
    if not math.isfinite(value):
        return "-"
    if name in _MM:
        return f"{1e3 * value:.2f}"
    return f"{100 * value:.1f}" if "coverage" in name else f"{value:.3f}"


def _format_span(values: Sequence[float]) -> str:
    if not values:
        return "-"
    low, high = 100 * min(values), 100 * max(values)
    return f"{low:.2f} to {high:.2f} %" if len(values) > 1 else f"{low:.2f} %"

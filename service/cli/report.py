"""Estimates of a session as tables and lines of text for people, and as JSON for programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median

from rich.table import Table

from service.cli.options import echo, remark, stdout
from service.estimation.stances import Stance
from service.offline.accuracy import MIN_COP_GRF_N, MIN_GRF_N, Accuracy
from service.offline.estimate_summary import EstimateSummary

PHASES = {
    "flight": "in flight",
    "loading": "while loading",
    "mid_stance": "in mid-stance",
    "unloading": "while unloading",
}
ASSUMED_SCALE = "The scale of this calibration is assumed: do not trust the newtons."
PULL_MIN_S = 0.25
EMULATED = "Errors of an emulated foot; the paper's 1 N and 4 mm are a real one's."


def make_accuracy_table(a: Accuracy) -> Table:
    """Return a table of errors against the truth of an emulated scene."""
    table = Table(title="Error against the truth", caption=EMULATED, title_justify="left")
    table.add_column("quantity")
    table.add_column("value", justify="right")
    table.add_column("over")
    grf = f"{a.grf_frames} frames above {MIN_GRF_N} N, unsaturated"
    cop = f"{a.cop_frames} frames above {MIN_COP_GRF_N} N"
    stances = f"{a.stances} stances"
    for name, value, unit, over in (
        ("GRF mean absolute", a.grf_mae_n, "N", grf),
        ("GRF RMS", a.grf_rms_n, "N", grf),
        ("GRF bias", a.grf_bias_n, "N", grf),
        ("GRF within 1.96 sigma", 100 * a.grf_coverage_95, "%", grf),
        *(
            (f"  {PHASES[phase]}", 100 * c.share, "%", f"{c.frames} frames, unsaturated")
            for phase, c in a.grf_phases.items()
        ),
        ("GRF sigma, median", a.grf_sigma_median_n, "N", grf),
        ("  in mid-stance", a.grf_sigma_mid_stance_n, "N", "frames in mid-stance"),
        ("GRF when published", a.grf_published_mae_n, "N", "the truth one look-ahead later"),
        ("GRF in flight, mean", a.flight_mean_n, "N", "frames without load"),
        ("GRF in flight, mean absolute", a.flight_mae_n, "N", "frames without load"),
        ("GRF, largest frame", a.peak_error_n, "N", stances),
        ("GRF impulse", a.impulse_error_ns, "N s", stances),
        ("COP mean", 1e3 * a.cop_mean_m, "mm", cop),
        ("COP 95th percentile", 1e3 * a.cop_p95_m, "mm", cop),
        ("COP x within 1.96 sigma", 100 * a.cop_coverage_95, "%", cop),
    ):
        table.add_row(name, "-" if math.isnan(value) else f"{value:.3f} {unit}", over)
    heavy = a.cop_frames + a.cop_masked_frames
    share = "" if math.isnan(a.cop_masked_share) else f" ({100 * a.cop_masked_share:.1f} %)"
    table.add_row(
        "COP not stated", f"{a.cop_masked_frames}{share}", f"{heavy} frames above {MIN_COP_GRF_N} N"
    )
    table.add_row("saturated", str(a.saturated_frames), f"{a.frames} frames")
    if a.bounds.frames:
        text = f"{100 * a.bounds.share:.2f} % hold"
        table.add_row("lower bounds of the GRF", text, f"{a.bounds.frames} frames without a GRF")
    after = a.after_saturation
    if after.frames:
        table.add_row(
            "after saturation",
            f"{a.after_saturation_mae_n:.3f} N",
            f"{after.frames} frames, {100 * after.share:.1f} % within 1.96 sigma",
        )
    return table


def print_findings(findings: EstimateSummary) -> None:
    """Print a summary of a session's estimates."""
    if findings.assumed_scale:
        echo(ASSUMED_SCALE)
    if findings.stances:
        echo(format_stances(findings.stances))
    if findings.pull.duration_s > PULL_MIN_S:
        remark(
            f"The GRF is below zero for {findings.pull.duration_s:.2f} s, by up to "
            f"{findings.pull.greatest_n:.1f} N: the foot was probably loaded during the tare. "
            "Name an unloaded interval with --tare-s BEGIN,END."
        )
    if findings.accuracy is not None:
        stdout.print(make_accuracy_table(findings.accuracy))


def make_findings_json(findings: EstimateSummary) -> dict[str, object]:
    """Return the summary for programs."""
    scale = {None: None, True: "assumed", False: "measured"}[findings.assumed_scale]
    return {
        "absolute_scale": scale,
        "stances": [stance.as_dict() for stance in findings.stances],
        "accuracy": findings.accuracy,
        "pull": findings.pull,
    }


def format_stances(stances: Sequence[Stance]) -> str:
    """Return number, median peak, impulse and duration of the stances.

    A median is stated if it is of most stances: a few whole ones may be of another kind.
    """
    hidden = [s for s in stances if not math.isfinite(s.peak_grf_n)]
    whole = [s for s in stances if s.is_whole]
    text = f"{len(stances)} stance{'s' if len(stances) != 1 else ''}"
    if hidden:
        text += f", {len(hidden)} with an unknown peak"
    if len(whole) < len(stances):
        text += f", {len(whole)} of them whole"
    if 2 * len(whole) <= len(stances):
        return f"{text}: no medians, as most are cut by gaps or an end of the session"
    peaks_n = [s.peak_grf_n for s in whole if math.isfinite(s.peak_sigma_n)]
    is_known = 2 * len(peaks_n) > len(stances)
    peak = (
        f"median peak {median(peaks_n):.2f} N"
        if is_known
        else "most peaks are lower bounds, for gaps"
    )
    return (
        f"{text}: {peak}, {'' if is_known else 'median '}impulse "
        f"{median(s.impulse_n_s for s in whole):.2f} N s, duration "
        f"{median(s.duration_s for s in whole):.2f} s"
    )

"""Files of a comparison: figures in JSON, report, plot, and compared values by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from service.json_output import to_json_text
from service.offline.compare.paired_frames import PairedFrames
from service.offline.compare.plot import plot_comparison
from service.offline.compare.report import FIGURES_WITH_LOWER_LIMIT, format_comparison_report
from service.offline.comparison import CompareOptions, compare_session
from storage.checksummed_json import write_checksummed_json
from storage.durable_files import write_atomically
from storage.schema import numpy_dtype_of
from storage.sessions.comparisons import (
    MAX_SERIES_ROWS,
    REPORT_NAME,
    SERIES_NAME,
    SERIES_SCHEMA,
    write_comparison_series,
)

_MISSING_FIGURE_HINTS = {
    **dict.fromkeys(
        ("grf_coverage_95",), ": give the reference's uncertainty with --reference-sigma-n"
    ),
    **dict.fromkeys(
        ("cop_coverage_x_95", "cop_coverage_y_95"),
        ": give the reference's COP uncertainty with --reference-cop-sigma-m",
    ),
    **dict.fromkeys(
        ("cop_mean_m", "cop_p95_m", "cop_bias_x_m", "cop_bias_y_m", "cop_p95_about_mean_m"),
        ": the reference has no centre of pressure under load",
    ),
}
"""Requirement of each figure that may be missing, appended to error messages."""


@dataclass(frozen=True)
class WrittenComparison:
    """Files of a comparison that were written.

    Attributes:
        content: content of `compare.json`.
        report_text: content of `compare.md`.
        missed_limits: descriptions of missed limits.
    """

    content: Mapping[str, Any]
    report_text: str
    missed_limits: tuple[str, ...]


def write_comparison(
    session_path: Path,
    reference_path: Path,
    options: CompareOptions,
    limits: Mapping[str, float],
    folder: Path,
    title: str,
) -> WrittenComparison:
    """Compare a sealed session with a reference; write figures, report, plot and series.

    `series.parquet` is not written if it would exceed `ROWS_MAX`.

    Args:
        session_path: the session's frames file.
        reference_path: the reference file.
        options: options of the comparison.
        limits: limits of figures' means, by name.
        folder: folder to write to.
        title: title of report and plot.

    Raises:
        FootTileError: as for `compare_session`; or a file cannot be written.
    """
    found = compare_session(session_path, reference_path, options)
    figures = found.errors.figures
    missed = tuple(
        missed_limit
        for name, limit in limits.items()
        if (missed_limit := _describe_missed_limit(name, figures[name].mean, limit)) is not None
    )
    text = format_comparison_report(
        title,
        found.alignment,
        found.clock_lag,
        found.pairs,
        found.errors,
        found.trial_definition,
        (*found.notes, *found.advice),
    )
    png = plot_comparison(title, found.pairs, found.tile_force_n, found.serials, found.errors)
    content = {**found.as_dict(), "limits": limits, "missed": missed}
    write_checksummed_json(folder / REPORT_NAME, to_json_text(content).encode())
    write_atomically(folder / "compare.md", text.encode())
    write_atomically(folder / "compare.png", png)
    if len(found.pairs.t_s) <= MAX_SERIES_ROWS:
        write_comparison_series(folder / SERIES_NAME, _build_series(found.pairs))
    else:  # of an earlier comparison
        (folder / SERIES_NAME).unlink(missing_ok=True)
    return WrittenComparison(content, text, missed)


def _build_series(pairs: PairedFrames) -> pa.Table:
    """Build the table of our frames at which the reference is known."""
    cop_m = np.where(pairs.reference_contact[:, None], pairs.reference_cop_m, np.nan)
    columns = {
        "t_ns": pairs.columns["t_ns"],
        "grf_n": pairs.columns["grf_n"],
        "reference_grf_n": pairs.reference_n,
        "reference_cop_x_m": cop_m[:, 0],
        "reference_cop_y_m": cop_m[:, 1],
    }
    return pa.table(
        [
            # from_pandas: NaN is null
            pa.array(columns[field.name].astype(numpy_dtype_of(field.type)), from_pandas=True)
            for field in SERIES_SCHEMA
        ],
        schema=SERIES_SCHEMA,
    )


def _describe_missed_limit(name: str, mean: float, limit: float) -> str | None:
    """Describe a missed limit; None if it is met."""
    if math.isnan(mean):
        hint = _MISSING_FIGURE_HINTS.get(name, "")
        return f"{name} is not known here, and was limited to {limit:g}{hint}"
    if name in FIGURES_WITH_LOWER_LIMIT:
        kept, words = mean >= limit, "at least"
    else:
        kept, words = abs(mean) <= limit, "at most"
    return None if kept else f"{name} is {mean:.4g}, and was to be {words} {limit:g}"

"""Files of a comparison: figures in JSON, report, plot, and compared values by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from service.offline.compare.pairs import Pairs
from service.offline.compare.plot import plot_comparison
from service.offline.compare.report import AT_LEAST, markdown
from service.offline.comparison import CompareOptions, compare_session
from service.plain_json import json_text
from storage.checked_json import write_checked
from storage.durable import write_whole
from storage.schema import numpy_dtype
from storage.sessions.comparisons import (
    REPORT_NAME,
    ROWS_MAX,
    SCHEMA,
    SERIES_NAME,
    write_series,
)

_WANTING = {
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
class Compared:
    """Files of a comparison that were written.

    Attributes:
        content: content of `compare.json`.
        text: content of `compare.md`.
        missed: descriptions of missed limits.
    """

    content: Mapping[str, Any]
    text: str
    missed: tuple[str, ...]


def write_comparison(
    source: Path,
    reference: Path,
    options: CompareOptions,
    limits: Mapping[str, float],
    folder: Path,
    title: str,
) -> Compared:
    """Compare a sealed session with a reference; write figures, report, plot and series.

    `series.parquet` is not written if it would exceed `ROWS_MAX`.

    Args:
        source: the session's frames file.
        reference: the reference file.
        options: options of the comparison.
        limits: limits of figures' means, by name.
        folder: folder to write to.
        title: title of report and plot.

    Raises:
        FootTileError: as for `compare_session`; or a file cannot be written.
    """
    found = compare_session(source, reference, options)
    figures = found.errors.figures
    missed = tuple(
        said
        for name, limit in limits.items()
        if (said := _missed(name, figures[name].mean, limit)) is not None
    )
    text = markdown(
        title,
        found.alignment,
        found.clock_lag,
        found.pairs,
        found.errors,
        found.trials_are,
        (*found.notes, *found.advice),
    )
    png = plot_comparison(title, found.pairs, found.force_n, found.serials, found.errors)
    content = {**found.as_dict(), "limits": limits, "missed": missed}
    write_checked(folder / REPORT_NAME, json_text(content).encode())
    write_whole(folder / "compare.md", text.encode())
    write_whole(folder / "compare.png", png)
    if len(found.pairs.t_s) <= ROWS_MAX:
        write_series(folder / SERIES_NAME, _series(found.pairs))
    else:  # of an earlier comparison
        (folder / SERIES_NAME).unlink(missing_ok=True)
    return Compared(content, text, missed)


def _series(pairs: Pairs) -> pa.Table:
    """Build the table of our frames at which the reference is known."""
    cop_m = np.where(pairs.contact[:, None], pairs.reference_cop_m, np.nan)
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
            pa.array(columns[field.name].astype(numpy_dtype(field.type)), from_pandas=True)
            for field in SCHEMA
        ],
        schema=SCHEMA,
    )


def _missed(name: str, mean: float, limit: float) -> str | None:
    """Describe a missed limit; None if it is met."""
    if math.isnan(mean):
        return f"{name} is not known here, and was limited to {limit:g}{_WANTING.get(name, '')}"
    if name in AT_LEAST:
        kept, words = mean >= limit, "at least"
    else:
        kept, words = abs(mean) <= limit, "at most"
    return None if kept else f"{name} is {mean:.4g}, and was to be {words} {limit:g}"

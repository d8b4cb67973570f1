"""A comparison as files: numbers in JSON, a report, a picture, and what was compared by frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from service.offline.compare.pairs import Pairs
from service.offline.compare.plot import plot_comparison
from service.offline.compare.report import markdown
from service.offline.comparison import CompareOptions, compare_session
from service.plain_json import json_text
from storage.checked_json import write_checked
from storage.durable import write_whole
from storage.sessions.comparisons import (
    REPORT_NAME,
    ROWS_MAX,
    SCHEMA,
    SERIES_NAME,
    write_series,
)


@dataclass(frozen=True)
class Compared:
    """What was written.

    Attributes:
        content: of `compare.json`.
        text: of `compare.md`.
        missed: limits that were, in words.
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
    """Compare a sealed session with a reference, into `compare.json` and what goes with it.

    These are a report, a picture, and `series.parquet`, unless that would be too long to be read.

    Args:
        source: its frames.
        reference: the file.
        options: how.
        limits: of figures, for their means.
        folder: to write in.
        title: of report and picture.

    Raises:
        FootTileError: as for `compare_session`; or a file cannot be written.
    """
    found = compare_session(source, reference, options)
    figures = found.errors.figures
    missed = tuple(
        f"{name} is {figures[name].mean:.4g}, and was to be within {limit:g}"
        for name, limit in limits.items()
        if not abs(figures[name].mean) <= limit
    )
    text = markdown(
        title,
        found.alignment,
        found.clock_lag,
        found.pairs,
        found.errors,
        found.trials_are,
        found.notes,
    )
    png = plot_comparison(title, found.pairs, found.force_n, found.serials, found.errors)
    content = {**found.as_dict(), "limits": limits, "missed": missed}
    write_checked(folder / REPORT_NAME, json_text(content).encode())
    write_whole(folder / "compare.md", text.encode())
    write_whole(folder / "compare.png", png)
    if len(found.pairs.t_s) <= ROWS_MAX:
        write_series(folder / SERIES_NAME, _series(found.pairs))
    else:  # that of a comparison before
        (folder / SERIES_NAME).unlink(missing_ok=True)
    return Compared(content, text, missed)


def _series(pairs: Pairs) -> pa.Table:
    """Every frame of ours at which the reference is known."""
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
            pa.array(columns[field.name].astype(field.type.to_pandas_dtype()), from_pandas=True)
            for field in SCHEMA
        ],
        schema=SCHEMA,
    )

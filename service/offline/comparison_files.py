"""A comparison as files: numbers in JSON, a report, a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.offline.compare.plot import plot_comparison
from service.offline.compare.report import markdown
from service.offline.comparison import CompareOptions, compare_session
from service.plain_json import json_text
from storage.checked_json import write_checked
from storage.durable import write_whole


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
    """Compare a sealed session with a reference, into compare.json, compare.md and compare.png.

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
    write_checked(folder / "compare.json", json_text(content).encode())
    write_whole(folder / "compare.md", text.encode())
    write_whole(folder / "compare.png", png)
    return Compared(content, text, missed)

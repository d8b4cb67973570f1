"""Metadata as lines of text, for formats without structured metadata."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from datetime import UTC, datetime

import numpy as np

from devices.arrays import Floats
from storage.formats.export import Export, read_completeness_and_losses
from storage.formats.writers.resampling import make_tile_row_metadata


def format_metadata(export: Export, begin_ns: int) -> dict[str, str]:
    """Return the metadata of an export by name, as ASCII text.

    A format that resamples or fills replaces the entries concerned.

    Args:
        export: the export.
        begin_ns: instant of its first sample, on the requested clock.
    """
    about, notes = export.provenance_and_slice_metadata, export.notes
    seconds, rest = divmod(begin_ns, 1_000_000_000)
    begin = datetime.fromtimestamp(seconds, tz=UTC).strftime("%Y-%m-%dT%H:%M:%S")
    clock = "the node's" if export.clock is None else "the server's"
    texts = {
        "SESSION": str(about.get("session") or "none: simulated or estimated by itself"),
        "NODE": export.array_info.node,
        "COMPLETE": _completeness_text(notes, export.provenance),
        "TIME_BASE": str(about["time_base"]),
        "AXES": str(about["axes"]),
        "RESAMPLED": str(about["resampled"]),
        "FILLED": str(about["filled"]),
        "MASKED": str(about["masked"]),
        "BEGIN_T_NS": str(begin_ns),
        "BEGIN_UTC": f"{begin}.{rest:09d}Z by {clock} clock"
        + (
            "" if export.array_info.clock_set or export.clock is not None else ", which was not set"
        ),
        "SLICE": f"{export.selection.start_s or 0.0:g} s to "
        + ("the end" if export.selection.end_s is None else f"{export.selection.end_s:g} s"),
        "CONTENT_SHA256": str(about.get("content_sha256") or "not sealed"),
        "CALIBRATION": _calibration_text(notes),
        "SCALE": str(notes.get("absolute_scale") or "not known"),
        "SOFTWARE": export.array_info.software,
        **make_tile_row_metadata(export.array_info),
    }
    return {name: to_ascii_line(text) for name, text in texts.items()}


def _completeness_text(notes: Mapping[str, object], source: Mapping[str, object]) -> str:
    complete, lost = read_completeness_and_losses(notes, source)
    if complete is None:
        return "not known: there is no ledger"
    losses = ", ".join(f"{count} {reason}" for reason, count in lost.items() if count)
    if complete == "lossy":
        text = f"lossy: {losses or 'frames are missing'}"
    else:
        text = "complete" if complete else f"not complete: it is {source.get('state', 'pending')}"
    ledger = notes.get("ledger")
    missed = ledger.get("missed_slots") if isinstance(ledger, dict) else None
    return f"{text}; {missed} slots in which no frame was taken" if missed else text


def format_largest_clock_bound(uncertainty_s: Floats | None) -> dict[str, str]:
    """Return the metadata entry with the largest bound of the server's time; empty if unknown.

    Args:
        uncertainty_s: bound of each sample; NaN for samples without frames. None: no clock.
    """
    if uncertainty_s is None or not np.isfinite(uncertainty_s).any():
        return {}
    return {
        "CLOCK_UNCERTAINTY": f"the truth is within {np.nanmax(uncertainty_s) * 1e3:.3f} ms of the "
        "axis at most; between two sessions, within the sum of both"
    }


def to_ascii_line(text: str) -> str:
    """Return text without accents, other characters outside ASCII as code points (U+1F600)."""
    line = " ".join(text.split())
    plain = unicodedata.normalize("NFKD", line)
    letters = (c for c in plain if not unicodedata.combining(c))
    return "".join(c if c.isascii() and c.isprintable() else f"U+{ord(c):04X}" for c in letters)


def _calibration_text(notes: Mapping[str, object]) -> str:
    found = notes.get("calibration")
    if not isinstance(found, dict):
        return "not known"
    return ", ".join(f"{name} {value}" for name, value in found.items() if isinstance(value, str))


_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def escape_xml_invalid_characters(text: str) -> str:
    r"""Return text with characters that XML does not allow as escapes: `\\ufffe`."""
    return _NOT_IN_XML.sub(lambda found: found[0].encode("unicode_escape").decode(), text)

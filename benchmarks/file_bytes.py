"""Bytes a frame of each quantity in sealed sessions of four tiles, as written before and now.

Before: all integers delta-encoded, estimates as computed, zstd's level 1. Now: what the sealed file
has. The same frames for both, in virtual time and on a real clock, whose jitter is most of a raw
file; the more of it the busier the machine is, so its quantiles are printed.

    python benchmarks/file_bytes.py [--seconds 120] [--real-s 100]
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import recording_data as data
import recording_formats as formats
import recording_sealing as sealing
from side_by_side import note, table

from service.estimation.calibration import Calibration, make_paper_shape_preset
from service.offline.calibration_lookup import find_calibration
from storage.journal.journal import Journal
from storage.schema import MEASURED_COLUMNS

RAW = frozenset(column.name for column in MEASURED_COLUMNS) | {"part"}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=120.0, help="in virtual time")
    parser.add_argument("--real-s", type=float, default=100.0, help="on a real clock; 0: none")
    parser.add_argument("--no-ladder", action="store_true", help="spare the bench, 20 s")
    asked = parser.parse_args()
    note("recording")
    recordings = [data.emulated(4, asked.seconds)]
    if asked.real_s:
        recordings.append(data.on_real_clock(4, asked.real_s))
    for recording in recordings:
        with tempfile.TemporaryDirectory() as folder:
            print("\n".join(measured(recording, Path(folder), with_ladder=not asked.no_ladder)))


def measured(recording: data.Recording, folder: Path, *, with_ladder: bool) -> list[str]:
    """Bytes a frame by quantity, and what the instants are like."""
    note(f"sealing {recording.title}")
    formats.write_journal(folder / "journal", recording)
    ways: dict[str, tuple[Calibration, tuple[str, ...]]] = {
        "`static`": (make_paper_shape_preset(), sealing.STATIC)
    }
    if with_ladder:
        ways["whole ladder"] = (
            find_calibration("emulated-rig", recording.info.serials),
            sealing.LADDER,
        )
    journal = Journal.open_existing_and_recover(folder / "journal")
    columns: dict[str, Counter[str]] = {}
    for name, (calibration, models) in ways.items():
        sources = sealing.sources_of(journal, calibration, models)
        now, exact = folder / "now.parquet", folder / "exact.parquet"
        sealing.seal(sources, now)
        sealing.seal(replace(sources, unquantized=True), exact)
        rows = formats.minute(recording.frames)
        columns[f"{name}, before"] = bytes_by_quantity(rewritten(exact, rows, as_before))
        columns[f"{name}, now"] = bytes_by_quantity(now)
    quantities = list(next(iter(columns.values())))
    groups = {
        "all raw": [q for q in quantities if q in RAW],
        "all estimates": [q for q in quantities if q not in RAW],
        "all": quantities,
    }
    n = len(recording.frames)
    lines = [
        (f"**{name}**", *(f"**{sum(found[q] for q in of) / n:.2f}**" for found in columns.values()))
        for name, of in groups.items()
    ]
    lines += [
        (f"`{q}`", *(f"{found[q] / n:.2f}" for found in columns.values())) for q in quantities
    ]
    head = (f"bytes a frame, {recording.title}", *columns)
    return ["", *table(head, lines), "", jitter(recording)]


def jitter(recording: data.Recording) -> str:
    """What the instants of a recording are like."""
    frames = recording.frames
    shares = (1, 50, 90, 99)

    def quantiles(values: Any) -> str:
        return ", ".join(f"{value:.0f}" for value in np.percentile(values, shares))

    return (
        f"{len(frames)} frames at {recording.rate_hz:.0f} Hz; 1, 50, 90 and 99 % of frames have at "
        f"most, in us: apart {quantiles(np.diff(frames.t_mono_ns) / 1000)}; offset of the last "
        f"tile {quantiles(frames.sample_offset_us[:, -1])}; age of the servo's position "
        f"{quantiles(frames.servo_age_us)}"
    )


def bytes_by_quantity(source: Path | pa.BufferReader) -> Counter[str]:
    """Bytes of all pages, the tiles of a quantity together."""
    found: Counter[str] = Counter()
    with pq.ParquetFile(source) as file:
        for group in range(file.metadata.num_row_groups):
            for at in range(file.metadata.num_columns):
                column = file.metadata.row_group(group).column(at)
                found[re.sub(r"_\d+$", "", column.path_in_schema)] += column.total_compressed_size
    return found


def rewritten(
    path: Path, rows: int, options_of: Callable[[pa.Schema], dict[str, Any]]
) -> pa.BufferReader:
    """The numbers of a sealed file, written otherwise."""
    frames = pq.read_table(path)
    sink = pa.BufferOutputStream()
    pq.write_table(frames, sink, row_group_size=rows, **options_of(frames.schema))
    return pa.BufferReader(sink.getvalue())


def as_before(schema: pa.Schema) -> dict[str, Any]:
    """As sealed files were written until decision 18."""
    return {
        "compression": "zstd",
        "use_dictionary": False,
        "write_page_checksum": True,
        "column_encoding": {
            field.name: "DELTA_BINARY_PACKED"
            if pa.types.is_integer(field.type)
            else "BYTE_STREAM_SPLIT"
            for field in schema
        },
    }


if __name__ == "__main__":
    main()

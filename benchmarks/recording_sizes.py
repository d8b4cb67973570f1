"""Bytes a frame in every format, and the least that it can take by the entropy of its columns."""

from __future__ import annotations

import re
from pathlib import Path

import pyarrow.parquet as pq
import recording_data as data
import recording_entropy as entropy
import recording_formats as formats
import recording_sealing as sealing
from recording_data import Extent
from side_by_side import note, table


def sizes(extent: Extent, folder: Path) -> list[str]:
    """Bytes a frame in every format, and against the bound."""
    walked = data.walked(extent.walk, extent.seconds)
    recordings = [
        data.emulated(4, extent.seconds),
        data.emulated(8, extent.seconds),
        *([data.on_real_clock(4, extent.real_s)] if extent.real_s else []),
        *([walked] if walked is not None else []),
    ]
    lines = [
        f"- {r.title}: {len(r.frames)} frames at {r.rate_hz:.0f} Hz, {r.seconds:.0f} s"
        for r in recordings
    ]
    if walked is None:
        lines.append(f"- a person's walk: not measured, no {data.WALK} in `{extent.walk}`")
    lines += [f"- {line}" for line in formats.absent()]
    rows: dict[str, list[str]] = {}
    for number, recording in enumerate(recordings):
        note(f"sizes of {recording.title}")
        place = folder / str(number)
        place.mkdir()
        for name, write in formats.writers().items():
            write(place / name.replace(" ", "_"), recording)
        n = len(recording.frames)
        sealed = place / "sealed_Parquet"
        per_frame = {
            name: formats.size_bytes(place / name.replace(" ", "_")) / n
            for name in formats.writers()
        }
        bound = _bound(recording, sealed)
        limit = sum(least for _, least in bound.values())
        for name, size in per_frame.items():
            against = f"{size:.1f} ({size / per_frame['sealed Parquet']:.2f})"
            rows.setdefault(name, [name]).append(against)
        for name, size in _with_estimates(recording, place / "estimated", extent).items():
            rows.setdefault(name, [name]).append(
                f"{size:.1f} ({size / per_frame['sealed Parquet']:.2f})"
            )
        rows.setdefault("bound", ["bound by entropy"]).append(
            f"{limit:.1f} ({limit / per_frame['sealed Parquet']:.2f})"
        )
        times = sum(bound[name][1] for name in entropy.TIMES)
        rows.setdefault("times", ["of the bound: when it was"]).append(
            f"{100 * times / limit:.0f} %"
        )
        if recording.title in ("4 tiles, virtual time", "4 tiles, real clock"):
            lines += ["", f"Where the bytes are, {recording.title}:", ""]
            lines += table(
                ("quantity", "sealed Parquet B", "bound B"),
                [(f"`{name}`", f"{a:.2f}", f"{b:.2f}") for name, (a, b) in bound.items()],
            )
    head = ("bytes a frame (times sealed Parquet)", *(r.title for r in recordings))
    return [*table(head, list(rows.values())), "", *lines]


def _bound(recording: data.Recording, sealed_path: Path) -> dict[str, tuple[float, float]]:
    """By quantity: bytes in Parquet, and the lesser of that and what the predictor's code takes."""
    codes = entropy.bytes_per_frame(recording.frames)
    metadata = pq.ParquetFile(sealed_path).metadata
    stored = dict.fromkeys(codes, 0.0)
    for group in range(metadata.num_row_groups):
        for at in range(metadata.num_columns):
            column = metadata.row_group(group).column(at)
            name = re.sub(r"_\d+$", "", column.path_in_schema)
            stored[name] += column.total_compressed_size / len(recording.frames)
    return {name: (stored[name], min(stored[name], codes[name])) for name in codes}


def _with_estimates(recording: data.Recording, folder: Path, extent: Extent) -> dict[str, float]:
    formats.write_journal(folder / "journal", recording)
    jobs = sealing.jobs(recording, folder, with_ladder=extent.with_ladder)
    found = {}
    for name, stem in (("`static`", "static"), ("the whole ladder", "ladder")):
        job = jobs.get(f"with estimates, {name}")
        if job is not None:
            job()
            size = formats.size_bytes(folder / f"{stem}.parquet") / len(recording.frames)
            found[f"sealed Parquet with estimates, {name}"] = size
    return found

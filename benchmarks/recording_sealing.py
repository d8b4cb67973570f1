"""What sealing costs: the frames of a journal, raw or with estimates, into one Parquet file."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
from recording_data import FULL_RATE_HZ, Extent, Recording, emulated
from recording_formats import flat_table, minute, write_journal
from side_by_side import in_turns, note, spread, table

from service.estimation.calibration import Calibration, make_paper_shape_preset
from service.offline.calibration_lookup import find_calibration
from service.sessions.inputs import SessionFrames, SessionInputs
from service.sessions.stances import StancesWriter
from storage.journal.journal import Journal
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import Part, Session
from storage.sessions.writer import SealedFileWriter, parquet_options

STATIC = ("unwrap", "static")
LADDER = ("unwrap", "temperature", "gas", "static", "skew", "denoise", "hysteresis", "rubber")
"""All models; `ambient` needs a bare reference tile, which no scene here has."""


def sources_of(
    journal: Journal, calibration: Calibration | None, models: tuple[str, ...] = ()
) -> SessionInputs:
    """All that a journal holds, as a session."""
    stream_id, last = journal.info.stream_id, journal.stored.last
    part = Part(stream_id=stream_id, seq_first=0, seq_last=last)
    session = Session(
        id="20200101T000000Z-000000",
        name="benchmark",
        node=journal.info.node,
        state="sealing",
        started_t_ns=0,
        parts=(part,),
        scene=journal.info.scene,
    )
    return SessionInputs(
        session=session,
        info=journal.info.model_copy(update={"models": models}),
        journals={stream_id: journal},
        calibration=calibration,
        problem=None if calibration is not None else "none was asked for",
        tares=(),
        notes={},
    )


def seal(sources: SessionInputs, path: Path, *, with_stances: bool = True) -> int:
    """Write the file, its hash and stances, as `service.sessions.sealing.seal` does; its frames."""
    count = 0
    frames, stances = SessionFrames(sources), StancesWriter()
    with SealedFileWriter(path, sources.info, sources.notes) as writer:
        for batch, columns in frames:
            writer.append_frames(batch, columns)
            if with_stances:
                stances.try_add_frames(batch.seq, batch.t_ns, columns)
            count += len(batch)
    stances.try_write_or_delete_file(path.parent, compute_sha256(path))
    if sources.calibration is not None:
        assert frames.problem is None, frames.problem
    return count


def jobs(
    recording: Recording, folder: Path, *, with_ladder: bool
) -> dict[str, Callable[[], object]]:
    """Ways to seal the journal in `folder / "journal"`, and pyarrow's part of it alone."""
    journal = Journal.open_existing_and_recover(folder / "journal")
    table = flat_table(recording.frames)
    rows = minute(recording.frames)

    def bare() -> None:
        options = parquet_options(table.schema)
        pq.write_table(table, folder / "bare.parquet", row_group_size=rows, **options)

    def sealing(
        name: str,
        calibration: Calibration | None,
        models: tuple[str, ...],
        *,
        with_stances: bool = True,
    ) -> None:
        sources = sources_of(journal, calibration, models)
        count = seal(sources, folder / f"{name}.parquet", with_stances=with_stances)
        assert count == len(recording.frames)

    found: dict[str, Callable[[], object]] = {
        "pyarrow alone, from memory": bare,
        "raw": lambda: sealing("raw", None, ()),
        "with estimates, `static`, without stances": lambda: sealing(
            "static", make_paper_shape_preset(), STATIC, with_stances=False
        ),
        "with estimates, `static`": lambda: sealing("static", make_paper_shape_preset(), STATIC),
    }
    if with_ladder:
        bench = find_calibration("emulated-rig", recording.info.serials)
        found["with estimates, the whole ladder"] = lambda: sealing("ladder", bench, LADDER)
    return found


def sealed(extent: Extent, folder: Path) -> list[str]:
    """Journal to Parquet, scaled to an hour."""
    recording = emulated(4, extent.sealed_s)
    write_journal(folder / "journal", recording)
    ways = jobs(recording, folder, with_ladder=extent.with_ladder)
    note("sealing")
    in_turns(ways, 1)
    times = in_turns(ways, extent.turns)
    hour = 3600 * FULL_RATE_HZ / len(recording.frames)
    raw = statistics.median(times["raw"].cpu_s)
    rows = [
        (
            name,
            spread(taken.cpu_s, hour),
            spread(taken.wall_s, hour),
            f"{statistics.median(taken.cpu_s) / raw:.2f}",
            f"{3600 / (statistics.median(taken.cpu_s) * hour):.0f}",
        )
        for name, taken in times.items()
    ]
    head = ("an hour of 4 tiles at 544 Hz", "CPU s", "wall s", "CPU, times raw",
            "times faster than real time")  # fmt: skip
    return [
        *table(head, rows),
        "",
        f"Scaled from {len(recording.frames)} frames, {extent.turns} turns after one that is not "
        "counted; the SHA-256 of the file is included."
        + ("" if extent.with_ladder else " The whole ladder: not measured in a quick run."),
    ]

"""What keeping frames costs while they are taken, beside a bare write of the same bytes.

Jobs take turns batch by batch, each with its own file on the same disk, and are measured by the CPU
time of the thread that does them, calls of the kernel included. Paced, a batch comes every 25 ms as
on a node, so that caches are as cold as there; otherwise one follows the other at once.
"""

from __future__ import annotations

import mmap
import os
import statistics
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from recording_data import FULL_RATE_HZ, Extent, Recording, batches, emulated, lengthened
from side_by_side import note, spread, table

from devices.acquisition import AcquiredFrame
from devices.frames import FRAME_COLUMNS, FrameBatch
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.journal.node.in_flight import InFlightWriter
from storage.journal.node.journal import SYNC_INTERVAL_S, NodeJournal
from storage.schema import wire_schema
from storage.wire import EncodedBatch, decode_message, encode_frames

SYNCS_PER_S = 4
GOAL = 0.01
"""Share of a core that the journal may take beyond a bare write."""
Batches = list[tuple[FrameBatch, bytes]]


@dataclass
class Cost:
    """What one job took, an entry for each second of the recording.

    Attributes:
        cpu_s: CPU seconds, syncing included.
        wall_s: as long as its thread was at it.
        sync_cpu_s: of `cpu_s`, what syncing took.
    """

    cpu_s: list[float] = field(default_factory=list)
    wall_s: list[float] = field(default_factory=list)
    sync_cpu_s: list[float] = field(default_factory=list)

    def begin_second(self) -> None:
        """What is added from now on belongs to the next second."""
        for values in (self.cpu_s, self.wall_s, self.sync_cpu_s):
            values.append(0.0)

    @contextmanager
    def measured(self, *, syncing: bool = False) -> Iterator[None]:
        """Add what the block takes."""
        wall_s, cpu_s = time.perf_counter(), time.thread_time()
        yield
        spent_s = time.thread_time() - cpu_s
        self.cpu_s[-1] += spent_s
        self.wall_s[-1] += time.perf_counter() - wall_s
        if syncing:
            self.sync_cpu_s[-1] += spent_s

    def beyond(self, other: Cost) -> list[float]:
        """CPU seconds more than another job in the same second of the recording."""
        return [mine - theirs for mine, theirs in zip(self.cpu_s, other.cpu_s, strict=True)]


@dataclass(frozen=True)
class Job:
    """What is done with each batch, and four times a second."""

    put: Callable[[FrameBatch, bytes], object]
    sync: Callable[[], object]


def encoded(recording: Recording) -> Batches:
    """The recording in batches of 25 ms, each with its message."""
    schema = wire_schema(recording.info)
    return [(batch, encode_frames(batch, schema)) for batch in batches(recording.frames)]


def append_costs(recording: Recording, folder: Path, *, paced: bool) -> dict[str, Cost]:
    """A bare write, the journal, and what goes with it, batch by batch in turns."""
    schema = wire_schema(recording.info)
    folder.mkdir()
    with ExitStack() as stack:
        journal = Journal(folder / "journal", recording.info)
        stack.callback(journal.close)
        raw = _raw_file(folder / "raw.arrows", stack)
        costs = _in_turns(
            {
                "bare write": Job(lambda _, payload: os.write(raw, payload), lambda: os.fsync(raw)),
                "Journal.append": Job(journal.append_new_frames, journal.sync),
                "decode (checks everything)": Job(lambda _, p: decode_message(p, schema), _nothing),
                "encode": Job(lambda batch, _: encode_frames(batch, schema), _nothing),
            },
            encoded(recording),
            paced=paced,
        )
    _whole_seconds(costs)
    return costs


def node_costs(recording: Recording, folder: Path) -> dict[str, Cost]:
    """The node's journal with its thread, a session needing every frame; always at its pace."""
    folder.mkdir()
    with ExitStack() as stack:
        raw = _raw_file(folder / "raw.arrows", stack)
        keeper = NodeJournal(folder, "bench")
        keeper.retention_requests.set_node_session_numbers(
            {recording.info.stream_id: Intervals([(0, 2**61)])}
        )
        before = set(threading.enumerate())
        keeper.start_writer()
        stack.callback(keeper.end_streams_and_close)
        (thread,) = set(threading.enumerate()) - before
        clock = time.pthread_getcpuclockid(thread.ident or 0)
        stream = keeper.switch_to_new_stream(recording.info)

        def put(batch: FrameBatch, payload: bytes) -> None:
            keeper.queue_batch_and_limit_memory(
                stream, EncodedBatch.from_frames_and_payload(batch, payload)
            )

        bare, node = "bare write", "NodeJournal.put and its thread"
        of_thread: list[float] = []
        last_s = time.clock_gettime(clock)

        def note_thread() -> None:
            nonlocal last_s
            now_s = time.clock_gettime(clock)
            of_thread.append(now_s - last_s)
            last_s = now_s

        costs = _in_turns(
            {
                bare: Job(lambda _, payload: os.write(raw, payload), lambda: os.fsync(raw)),
                node: Job(put, _nothing),
            },
            encoded(recording),
            paced=True,
            sync_s=SYNC_INTERVAL_S,
            each_second=note_thread,
        )
    # What was noted at the begin of a second is of the one before.
    del of_thread[0]
    _whole_seconds(costs, of_thread)
    both = costs[node]
    both.cpu_s = [put_s + thread_s for put_s, thread_s in zip(both.cpu_s, of_thread, strict=True)]
    return costs


def in_flight_costs(recording: Recording, folder: Path) -> dict[str, Cost]:
    """`InFlight.put` for each frame, as the loop that takes frames calls it."""
    columns = [getattr(recording.frames, name).tolist() for name in AcquiredFrame._fields]
    rows = [AcquiredFrame(*values) for values in zip(*columns, strict=True)]
    keeper = InFlightWriter(folder, recording.info)
    tiles = recording.frames.tile_count
    size = 4 + sum(
        dtype.itemsize * (tiles if per_tile else 1) for dtype, per_tile in FRAME_COLUMNS.values()
    )
    bare = mmap.mmap(-1, size * 8192)
    row_bytes = bytes(size)
    costs = {"bare copy": Cost(), "InFlight.put": Cost()}
    rate = round(recording.rate_hz)
    for begin in range(0, len(rows) - rate + 1, rate):
        for cost in costs.values():
            cost.begin_second()
        with costs["bare copy"].measured():
            for seq in range(begin, begin + rate):
                at = (seq % 8192) * size
                bare[at : at + size] = row_bytes
        with costs["InFlight.put"].measured():
            for row in rows[begin : begin + rate]:
                keeper.write_frame(row)
    keeper.close()
    bare.close()
    return costs


def _in_turns(
    jobs: dict[str, Job],
    every: Batches,
    *,
    paced: bool,
    sync_s: float = 1.0 / SYNCS_PER_S,
    each_second: Callable[[], None] | None = None,
) -> dict[str, Cost]:
    costs = {name: Cost() for name in jobs}
    begin_ns = int(every[0][0].t_mono_ns[0])
    begin_s = time.monotonic()
    second, synced_s = -1, 0.0
    for number, (batch, payload) in enumerate(every):
        at_s = (int(batch.t_mono_ns[-1]) - begin_ns) * 1e-9
        if int(at_s) > second:
            if each_second is not None:
                each_second()
            second = int(at_s)
            for cost in costs.values():
                cost.begin_second()
        if paced:
            time.sleep(max(0.0, begin_s + at_s - time.monotonic()))
        turn = list(jobs) if number % 2 == 0 else list(reversed(jobs))
        for name in turn:
            with costs[name].measured():
                jobs[name].put(batch, payload)
        if at_s - synced_s >= sync_s:
            synced_s = at_s
            for name in turn:
                with costs[name].measured(syncing=True):
                    jobs[name].sync()
    if each_second is not None:
        each_second()
    return costs


def _raw_file(path: Path, stack: ExitStack) -> int:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    stack.callback(os.close, descriptor)
    return descriptor


def _whole_seconds(costs: Mapping[str, Cost], *others: list[float]) -> None:
    """Leave out the first second, which opens files, and the last, which is none."""
    lists = [v for c in costs.values() for v in (c.cpu_s, c.wall_s, c.sync_cpu_s)]
    for values in (*lists, *others):
        del values[-1], values[0]


def _nothing() -> None:
    """Nothing is to be synced."""


def appending(extent: Extent, folder: Path) -> list[str]:
    """What keeping frames costs while they are taken."""
    pattern = emulated(8, extent.seconds)
    recording = lengthened(pattern, extent.cost_s, FULL_RATE_HZ)
    every = encoded(recording)
    rows = []
    met = []
    for paced in (True, False):
        note(f"appending, {'paced' if paced else 'one after another'}")
        found = append_costs(recording, folder / f"append-{paced}", paced=paced)
        rows += _cost_rows(found, "every 25 ms" if paced else "at once", len(every), recording)
        more = statistics.median(found["Journal.append"].beyond(found["bare write"]))
        met.append(f"{100 * more:.2f} % {'paced' if paced else 'one after another'}")
    note("the node's journal")
    found = node_costs(recording, folder / "node")
    rows += _cost_rows(found, "every 25 ms, 5 syncs/s", len(every), recording)
    note("frames in flight")
    flight = in_flight_costs(recording, folder / "flight")
    scale = 1e6 / round(recording.rate_hz)
    head = ("job", "pace", "CPU us a batch", "of it syncing", "wall us a batch", "% of a core",
            "% of a core beyond the bare write")  # fmt: skip
    return [
        *table(head, rows, 2),
        "",
        *table(
            ("each frame", "CPU us", "% of a core"),
            [
                (f"`{name}`", spread(cost.cpu_s, scale, 2), spread(cost.cpu_s, 100, 3))
                for name, cost in flight.items()
            ],
        ),
        "",
        f"8 tiles at {recording.rate_hz:.0f} Hz, {len(every)} batches of "
        f"{statistics.mean(len(p) for _, p in every):.0f} bytes, {extent.cost_s:g} s; "
        "medians over seconds of the recording, and the least and the greatest of them. "
        f"`Journal.append` beyond the bare write: {', '.join(met)}; the goal is {100 * GOAL:g} %.",
    ]


def _cost_rows(
    found: dict[str, Cost], pace: str, batch_count: int, recording: Recording
) -> list[tuple[str, ...]]:
    scale = 1e6 * recording.seconds / batch_count
    bare = found["bare write"]
    return [
        (
            name if name == "bare write" else f"`{name}`" if "." in name else name,
            pace,
            spread(cost.cpu_s, scale, 0),
            spread(cost.sync_cpu_s, scale, 0) if any(cost.sync_cpu_s) else "-",
            spread(cost.wall_s, scale, 0) if "thread" not in name else "-",
            spread(cost.cpu_s, 100, 2),
            "-" if cost is bare else spread(cost.beyond(bare), 100, 2),
        )
        for name, cost in found.items()
    ]

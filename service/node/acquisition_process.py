"""Acquisition in a separate process, so that no other work of the node disturbs its timing.

The child opens the array, acquires frames and encodes them; a thread of the child sends them
through a pipe. The parent receives `WaitingForArray` for each failed attempt to open an absent
array, then `AcquisitionStarted` and `AcquiredBatch` messages, and `AcquisitionStarted` again when a
replaced part begins a new stream; `AcquisitionEnded` is the last message. The child ends on
request, or when its parent died and the pipe breaks.
"""

from __future__ import annotations

import errno
import multiprocessing
import queue
import signal
import threading
import traceback
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

from devices.errors import (
    BusMisuseError,
    BusSetupError,
    FootTileError,
    I2cError,
    SpiError,
    SpiSetupError,
    TileSetupError,
)
from devices.frames import ArrayInfo, Edge, FrameBatch
from devices.realtime import freeze_garbage_collector
from service.rig.emulated_foot import RigOptions
from service.rig.rig import Rig
from storage.schema import wire_schema
from storage.wire import EncodedBatch, encode_frames


class WarningDebouncer:
    """Debouncer of warnings: a warning has to be present in two updates in a row.

    Shorter faults show only in the frames' flags.
    """

    def __init__(self) -> None:
        self._last: Mapping[str, str] = {}
        self._debounced: dict[str, str] = {}

    @property
    def debounced_texts(self) -> tuple[str, ...]:
        """Texts of the present debounced warnings."""
        return tuple(self._debounced.values())

    def update(self, warnings_by_part: Mapping[str, str]) -> tuple[str, ...]:
        """Update with the present warnings; return messages about begun and ended ones.

        Args:
            warnings_by_part: texts of the present warnings, by faulty part.
        """
        lasting = {
            what: text for what, text in warnings_by_part.items() if self._last.get(what) == text
        }
        new = [text for what, text in lasting.items() if self._debounced.get(what) != text]
        over = [
            what
            for what in self._debounced
            if what not in warnings_by_part and what not in self._last
        ]
        self._last = dict(warnings_by_part)
        self._debounced |= lasting
        return (*new, *(f"no longer: {self._debounced.pop(what)}" for what in over))


_QUEUED_BATCHES_MAX = 4096
"""Queue limit in batches, 100 s; while the parent reads none, later frames are lost and counted as
a gap in `seq`."""
_END_TIMEOUT_S = 5.0
"""Timeout of a requested end, before the process is killed."""
REOPEN_INTERVAL_S = 1.0
"""Interval of attempts to open an absent array."""
_ABSENT = {errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EBUSY}
_HEALTH_INTERVAL_NS = 500_000_000
"""Interval of health checks of the array, in the stream's time."""


@dataclass(frozen=True)
class AcquisitionStarted:
    """Message that the array is open; frames follow."""

    info: ArrayInfo
    startup_messages: tuple[str, ...] = ()
    """Start-up messages for the user."""


@dataclass(frozen=True)
class WaitingForArray:
    """Message that the array could not be opened; retries follow."""

    problem: str


@dataclass(frozen=True)
class ArrayHealth:
    """Health of the array.

    Attributes:
        warnings: texts of the present warnings.
        fault_counts: fault counts of the stream, by serial and reason.
    """

    warnings: tuple[str, ...] = ()
    fault_counts: Mapping[str, Mapping[str, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class AcquiredBatch:
    """Message with frames, and the present counters and health."""

    encoded_batch: EncodedBatch
    missed_slots: int
    warning_changes: tuple[str, ...] = ()
    """Messages about warnings that began or ended."""
    health: ArrayHealth = ArrayHealth()  # frozen, so one for all is safe


@dataclass(frozen=True)
class AcquisitionEnded:
    """Last message: the error that ended acquisition; None: ended on request."""

    error: BaseException | None


AcquisitionMessage = WaitingForArray | AcquisitionStarted | AcquiredBatch | AcquisitionEnded
_Item = tuple[FrameBatch, tuple[Edge, ...], int, tuple[str, ...], ArrayHealth]


class AcquisitionProcess:
    """Child process of acquisition, with a thread of the parent that receives its messages.

    Args:
        options: options of the rig.
        on_message: called with every message, from that thread.
    """

    def __init__(
        self, options: RigOptions, on_message: Callable[[AcquisitionMessage], None]
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_run_child, args=(options, theirs), name="acquisition", daemon=True
        )
        self._on_message = on_message
        self._process.start()
        theirs.close()
        self._thread = threading.Thread(
            target=self._receive_messages, name="acquisition", daemon=True
        )
        self._thread.start()

    def request_stop(self) -> None:
        """Request the end; the last frames still arrive, then `AcquisitionEnded(None)`."""
        with suppress(OSError):
            self._connection.send(None)

    def close(self) -> None:
        """End the process: request it, then kill it after a timeout."""
        self.request_stop()
        self._process.join(_END_TIMEOUT_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(_END_TIMEOUT_S)
        self._thread.join(_END_TIMEOUT_S)
        self._connection.close()

    def _receive_messages(self) -> None:
        try:
            while True:
                message: AcquisitionMessage = self._connection.recv()
                self._on_message(message)
                if isinstance(message, AcquisitionEnded):
                    return
        except (EOFError, OSError):
            self._process.join(_END_TIMEOUT_S)
            self._on_message(
                AcquisitionEnded(
                    FootTileError(
                        f"the acquisition process {_describe_exit(self._process.exitcode)}",
                        remedy="Look at what it wrote to stderr before. Start the node again: a "
                        "new stream begins, sessions go on in it",
                    )
                )
            )


def _describe_exit(code: int | None) -> str:
    if code is None:
        return "does not respond any more"
    if code >= 0:
        return f"ended with code {code}"
    with suppress(ValueError):  # a signal without a name
        return f"was killed by {signal.Signals(-code).name}"
    return f"was killed by signal {-code}"


def _run_child(options: RigOptions, connection: Connection) -> None:
    """Run the child process."""
    # Ctrl-C and a service manager's stop signal the whole group; only the parent may end the child.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    stop = threading.Event()
    threading.Thread(target=_await_stop, args=(connection, stop), daemon=True).start()
    # Sent before devices are closed: hung hardware may block that. The parent may have died.
    with suppress(OSError), ExitStack() as stack:
        connection.send(AcquisitionEnded(_acquire_until_stop(options, connection, stop, stack)))


def _acquire_until_stop(
    options: RigOptions, connection: Connection, stop: threading.Event, stack: ExitStack
) -> FootTileError | None:
    """Acquire frames until the stop; return the error of an earlier end, else None."""
    try:
        rig = _open_rig(options, connection, stop, stack)
        if rig is None:
            return None
        freeze_garbage_collector()
        while not stop.is_set():  # a replaced part begins a new stream
            _acquire_stream(rig, connection, stop)
    except FootTileError as error:
        return error
    except ConnectionError:  # the parent has died
        return None
    except Exception as error:
        traceback.print_exc()
        return FootTileError(
            f"acquisition has failed: {type(error).__name__}: {error}",
            remedy="This is a bug. Start the node again: a new stream begins, sessions go on in it",
        )
    return None


def _open_rig(
    options: RigOptions, connection: Connection, stop: threading.Event, stack: ExitStack
) -> Rig | None:
    """Open the array, with retries while it may still appear; None if stopped before.

    A node that starts with its robot may start before the sensors have power. No retries for
    emulated tiles: the time of their faults begins with the first frame.

    Raises:
        FootTileError: the array cannot be opened, and a retry does not help.
    """
    while True:
        attempt, waits = ExitStack(), False
        try:
            return Rig(options, attempt)
        except (I2cError, SpiError, TileSetupError) as error:
            waits = not options.is_emulated and _may_recover(error)
            if not waits:
                raise
            attempt.close()
            connection.send(WaitingForArray(str(error)))
        finally:
            if not waits:  # after a final failure close only after the report
                stack.enter_context(attempt)
        if stop.wait(REOPEN_INTERVAL_S):
            return None


def _may_recover(error: FootTileError) -> bool:
    """Return whether absent hardware may appear without a change of the configuration."""
    if isinstance(error, (BusSetupError, SpiSetupError)):
        number = error.errno or getattr(error.__cause__, "errno", None)
        return number in _ABSENT
    return not isinstance(error, BusMisuseError)


def _acquire_stream(rig: Rig, connection: Connection, stop: threading.Event) -> None:
    connection.send(AcquisitionStarted(rig.info, tuple(rig.startup_messages)))
    rig.startup_messages.clear()
    notices, look_ns, health = WarningDebouncer(), 0, ArrayHealth()
    waiting: queue.Queue[_Item | None] = queue.Queue(_QUEUED_BATCHES_MAX)
    sender = threading.Thread(target=_send_batches, args=(rig.info, waiting, connection, stop))
    sender.start()
    try:
        for batch in rig.acquire_batches(stop.is_set):
            edges = rig.take_edges()
            changes: tuple[str, ...] = ()
            if batch.t_mono_ns[-1] >= look_ns:
                changes = notices.update(rig.get_warnings())
                health = ArrayHealth(notices.debounced_texts, rig.get_fault_counts())
                look_ns = int(batch.t_mono_ns[-1]) + _HEALTH_INTERVAL_NS
            with suppress(queue.Full):
                waiting.put_nowait((batch, edges, rig.acquisition.missed_slots, changes, health))
    finally:
        waiting.put(None)
        sender.join()


def _send_batches(
    info: ArrayInfo,
    waiting: queue.Queue[_Item | None],
    connection: Connection,
    stop: threading.Event,
) -> None:
    schema = wire_schema(info)
    while (item := waiting.get()) is not None:
        frames, edges, missed_slots, notices, health = item
        payload = encode_frames(frames, schema, edges)
        encoded = EncodedBatch.from_frames_and_payload(frames, payload)
        try:
            connection.send(AcquiredBatch(encoded, missed_slots, notices, health))
        except OSError:
            stop.set()
            return


def _await_stop(connection: Connection, stop: threading.Event) -> None:
    with suppress(EOFError, OSError):
        connection.recv()
    stop.set()

"""Acquisition in a separate process, so that no other work of the node disturbs its timing.

The child opens the array, acquires frames and encodes them; a thread of the child sends them
through a pipe. The parent receives `Waiting` for each failed attempt to open an absent array, then
`Started` and `Batch` messages, and `Started` again when a replaced part begins a new stream;
`Failed` is the last message. The child ends on request, or when its parent died and the pipe
breaks.
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
from devices.frames import ArrayInfo, FrameBatch
from devices.realtime import spare_what_is_loaded
from service.node.notices import Notices
from service.rig.options import RigOptions
from service.rig.rig import Rig
from storage.schema import wire_schema
from storage.wire import EncodedBatch, encode

_WAITING_MAX = 4096
"""Queue limit in batches, 100 s; while the parent reads none, later frames are lost and counted as
a gap in `seq`."""
_END_S = 5.0
"""Timeout of a requested end, before the process is killed."""
OPEN_AGAIN_S = 1.0
"""Interval of attempts to open an absent array."""
_ABSENT = {errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EBUSY}
_LOOK_EVERY_NS = 500_000_000
"""Interval of health checks of the array, in the stream's time."""


@dataclass(frozen=True)
class Started:
    """Message that the array is open; frames follow."""

    info: ArrayInfo
    remarks: tuple[str, ...] = ()
    """Start-up messages for the user."""


@dataclass(frozen=True)
class Waiting:
    """Message that the array could not be opened; retries follow."""

    problem: str


@dataclass(frozen=True)
class Health:
    """Health of the array.

    Attributes:
        troubles: texts of the present warnings.
        counts: fault counts of the stream, by serial and reason.
    """

    troubles: tuple[str, ...] = ()
    counts: Mapping[str, Mapping[str, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Batch:
    """Message with frames, and the present counters and health."""

    batch: EncodedBatch
    missed_slots: int
    notices: tuple[str, ...] = ()
    """Messages about warnings that began or ended."""
    health: Health = Health()  # frozen, so one for all is safe


@dataclass(frozen=True)
class Failed:
    """Last message: the error that ended acquisition; None: ended on request."""

    error: BaseException | None


Message = Waiting | Started | Batch | Failed
_Item = tuple[FrameBatch, int, tuple[str, ...], Health]


class AcquisitionProcess:
    """Child process of acquisition, with a thread of the parent that receives its messages.

    Args:
        options: options of the rig.
        on_message: called with every message, from that thread.
    """

    def __init__(self, options: RigOptions, on_message: Callable[[Message], None]) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_run, args=(options, theirs), name="acquisition", daemon=True
        )
        self._on_message = on_message
        self._process.start()
        theirs.close()
        self._thread = threading.Thread(target=self._listen, name="acquisition", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Request the end; the last frames still arrive, then `Failed(None)`."""
        with suppress(OSError):
            self._connection.send(None)

    def close(self) -> None:
        """End the process: request it, then kill it after a timeout."""
        self.stop()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(_END_S)
        self._thread.join(_END_S)
        self._connection.close()

    def _listen(self) -> None:
        try:
            while True:
                message: Message = self._connection.recv()
                self._on_message(message)
                if isinstance(message, Failed):
                    return
        except (EOFError, OSError):
            self._process.join(_END_S)
            self._on_message(
                Failed(
                    FootTileError(
                        f"the acquisition process {_how_ended(self._process.exitcode)}",
                        remedy="Look at what it wrote to stderr before. Start the node again: a "
                        "new stream begins, sessions go on in it",
                    )
                )
            )


def _how_ended(code: int | None) -> str:
    if code is None:
        return "does not respond any more"
    if code >= 0:
        return f"ended with code {code}"
    with suppress(ValueError):  # a signal without a name
        return f"was killed by {signal.Signals(-code).name}"
    return f"was killed by signal {-code}"


def _run(options: RigOptions, connection: Connection) -> None:
    """Run the child process."""
    # Ctrl-C and a service manager's stop signal the whole group; only the parent may end the child.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    stop = threading.Event()
    threading.Thread(target=_await_stop, args=(connection, stop), daemon=True).start()
    # Sent before devices are closed: hung hardware may block that. The parent may have died.
    with suppress(OSError), ExitStack() as stack:
        connection.send(Failed(_streamed(options, connection, stop, stack)))


def _streamed(
    options: RigOptions, connection: Connection, stop: threading.Event, stack: ExitStack
) -> FootTileError | None:
    """Acquire frames until the stop; return the error of an earlier end, else None."""
    try:
        rig = _open_rig(options, connection, stop, stack)
        if rig is None:
            return None
        spare_what_is_loaded()
        while not stop.is_set():  # a replaced part begins a new stream
            _stream(rig, connection, stop)
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
            waits = not options.emulated and _may_pass(error)
            if not waits:
                raise
            attempt.close()
            connection.send(Waiting(str(error)))
        finally:
            if not waits:  # after a final failure close only after the report
                stack.enter_context(attempt)
        if stop.wait(OPEN_AGAIN_S):
            return None


def _may_pass(error: FootTileError) -> bool:
    """Return whether absent hardware may appear without a change of the configuration."""
    if isinstance(error, (BusSetupError, SpiSetupError)):
        return getattr(error.__cause__, "errno", None) in _ABSENT
    return not isinstance(error, BusMisuseError)


def _stream(rig: Rig, connection: Connection, stop: threading.Event) -> None:
    connection.send(Started(rig.info, tuple(rig.remarks)))
    rig.remarks.clear()
    notices, look_ns, health = Notices(), 0, Health()
    waiting: queue.Queue[_Item | None] = queue.Queue(_WAITING_MAX)
    sender = threading.Thread(target=_send, args=(rig.info, waiting, connection, stop))
    sender.start()
    try:
        for batch in rig.batches(stop.is_set):
            changes: tuple[str, ...] = ()
            if batch.t_mono_ns[-1] >= look_ns:
                changes = notices.since(rig.troubles())
                health = Health(notices.lasting, rig.counts())
                look_ns = int(batch.t_mono_ns[-1]) + _LOOK_EVERY_NS
            with suppress(queue.Full):
                waiting.put_nowait((batch, rig.acquisition.missed_slots, changes, health))
    finally:
        waiting.put(None)
        sender.join()


def _send(
    info: ArrayInfo,
    waiting: queue.Queue[_Item | None],
    connection: Connection,
    stop: threading.Event,
) -> None:
    schema = wire_schema(info)
    while (item := waiting.get()) is not None:
        frames, missed_slots, notices, health = item
        encoded = EncodedBatch.of(frames, encode(frames, schema))
        try:
            connection.send(Batch(encoded, missed_slots, notices, health))
        except OSError:
            stop.set()
            return


def _await_stop(connection: Connection, stop: threading.Event) -> None:
    with suppress(EOFError, OSError):
        connection.recv()
    stop.set()

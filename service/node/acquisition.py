"""Acquisition in a process of its own, so that nothing else on the node disturbs its pace.

The child opens the array, takes frames and encodes them; a thread of it sends them through a pipe.
On hardware it may have to wait for the array: the parent gets `Waiting` each time it was not there.
The parent gets `Started`, then `Batch` after `Batch`, and `Started` again when the array
has become another one, with which a new stream begins; a `Failed` ends it. The child ends when it
is told to, or when the pipe breaks because its parent died.
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
"""Batches that may wait for a parent that does not read, 100 s; then frames are lost and counted
as a gap in `seq`."""
_END_S = 5.0
"""How long a process that is told to end has before it is killed."""
OPEN_AGAIN_S = 1.0
"""Between two attempts to open an array that is not there."""
_ABSENT = {errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EBUSY}
_LOOK_EVERY_NS = 500_000_000
"""Interval at which the array is asked for its health, in the stream's own time."""


@dataclass(frozen=True)
class Started:
    """The array was found; frames follow."""

    info: ArrayInfo
    remarks: tuple[str, ...] = ()
    """What a user should hear about it."""


@dataclass(frozen=True)
class Waiting:
    """The array could not be opened; it is asked for again."""

    problem: str


@dataclass(frozen=True)
class Health:
    """How the array is.

    Attributes:
        troubles: what is wrong now, in words.
        counts: of what went wrong since the stream began, by serial and reason.
    """

    troubles: tuple[str, ...] = ()
    counts: Mapping[str, Mapping[str, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Batch:
    """Frames, and what was counted beside them so far."""

    batch: EncodedBatch
    missed_slots: int
    notices: tuple[str, ...] = ()
    """What has become wrong with the array, or right again."""
    health: Health = Health()  # frozen, so one for all is safe


@dataclass(frozen=True)
class Failed:
    """It ended for this reason, and no more will come; None: it was told to stop."""

    error: BaseException | None


Message = Waiting | Started | Batch | Failed
_Item = tuple[FrameBatch, int, tuple[str, ...], Health]


class AcquisitionProcess:
    """The child process, and a thread here that hands on what it says.

    Args:
        options: what to open.
        on_message: called for every message, from that thread.
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
        """Ask it to end; the last frames still come, then `Failed(None)`."""
        with suppress(OSError):
            self._connection.send(None)

    def close(self) -> None:
        """End the process: ask first, then kill it."""
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
        return "says nothing more"
    if code >= 0:
        return f"ended with code {code}"
    with suppress(ValueError):  # a signal without a name
        return f"was killed by {signal.Signals(-code).name}"
    return f"was killed by signal {-code}"


def _run(options: RigOptions, connection: Connection) -> None:
    """Body of the child process."""
    # Ctrl-C and a service manager's stop go to the whole group; the parent decides when this ends.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    stop = threading.Event()
    threading.Thread(target=_await_stop, args=(connection, stop), daemon=True).start()
    # Said before anything is closed: hardware that hangs may keep that waiting. A parent that died
    # wants no more messages.
    with suppress(OSError), ExitStack() as stack:
        connection.send(Failed(_streamed(options, connection, stop, stack)))


def _streamed(
    options: RigOptions, connection: Connection, stop: threading.Event, stack: ExitStack
) -> FootTileError | None:
    """Take frames until told to stop; why it ended before that, if it did."""
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
    """Open the array, again and again while it may yet come; None if told to stop before.

    A node that starts with its robot starts before the sensors have their supply. Emulated tiles do
    not come by being waited for: the time of their faults begins with the first frame.

    Raises:
        FootTileError: it cannot be opened, and waiting does not help.
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
            if not waits:  # what failed for good is closed after it was reported
                stack.enter_context(attempt)
        if stop.wait(OPEN_AGAIN_S):
            return None


def _may_pass(error: FootTileError) -> bool:
    """Return whether hardware that is not there now may come without a change of the set-up."""
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
            told: tuple[str, ...] = ()
            if batch.t_mono_ns[-1] >= look_ns:
                told = notices.since(rig.troubles())
                health = Health(notices.lasting, rig.counts())
                look_ns = int(batch.t_mono_ns[-1]) + _LOOK_EVERY_NS
            with suppress(queue.Full):
                waiting.put_nowait((batch, rig.acquisition.missed_slots, told, health))
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

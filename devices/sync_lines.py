"""Sync lines of a Raspberry Pi: edges of other instruments, and a signal or lamp while recording.

The kernel stamps each edge with CLOCK_MONOTONIC, the clock of the frames. Edges are read with each
frame, without waiting, so that those before a frame are known when it is stored. They have not
been run on a Raspberry Pi by this project: tests cover the calls of libgpiod with its own types.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from datetime import timedelta
from threading import Thread
from typing import TYPE_CHECKING, Protocol

from devices.acquisition import AcquiredFrame, FrameSink
from devices.clock import Clock, SystemClock
from devices.errors import require_extra
from devices.frames import Edge
from devices.gpio import translate_gpio_errors
from devices.lamp_code import BIT_NS, LAMP_LATE_NS, is_lamp_on, make_code
from devices.scene.hardware_sections import SyncSection

if TYPE_CHECKING:
    from gpiod import LineRequest, LineSettings

EDGES_PER_S_MAX = 2560
"""Edges that are stored a second, and as many as of 25 ms at once: others are dropped, counted."""
_EDGES_AT_ONCE_MAX = EDGES_PER_S_MAX // 40
_KERNEL_EDGES_MAX = 1024
"""Edges that wait in the kernel, its limit; it drops the oldest, as a gap in `line_seqno`."""
_DROP_WARNING_NS = 1_000_000_000
"""Time for which dropped edges are a warning."""
_LATE_SWITCHES = 64
"""Number of switches over which their lateness is averaged."""


def _request_line(scene: SyncSection, line: int, settings: LineSettings) -> LineRequest:
    import gpiod

    with translate_gpio_errors(scene.gpiochip, [line], "[sync]"):
        return gpiod.request_lines(
            scene.gpiochip,
            consumer="foottile",
            config={line: settings},
            event_buffer_size=_KERNEL_EDGES_MAX,
        )


class EdgeSink(FrameSink, Protocol):
    """Sink of frames that also receives the edges before them."""

    def write_edges(self, edges: Sequence[Edge]) -> None:
        """Store edges. It must be quick: the loop waits."""


class SyncInput:
    """Input line whose edges are read with each frame.

    A line that fails later is a warning, and has no more edges.

    Args:
        scene: its section.
        line: its `input_line`.

    Raises:
        MissingExtraError: gpiod is not installed.
        BusSetupError: the line is not there, in use, or forbidden.
    """

    def __init__(self, scene: SyncSection, line: int) -> None:
        self.dropped_edges = 0
        """Number of edges that came faster than they can be stored."""
        self._number = 0
        self._room = 0.0
        """Edges that may be stored now."""
        self._read_at_ns = 0
        self._problem = ""
        self._dropped_at_ns: float = -math.inf
        with require_extra("gpio", "the sync line"):
            from gpiod import LineSettings
            from gpiod.line import Bias, Direction
            from gpiod.line import Edge as EdgeType
        settings = LineSettings(
            direction=Direction.INPUT,
            edge_detection=EdgeType[scene.edge.upper()],
            bias=Bias[scene.bias.upper()],
            debounce_period=timedelta(microseconds=scene.debounce_us),
        )
        self._request = _request_line(scene, line, settings)

    @property
    def warning(self) -> str:
        """Warning about the line; empty if there is none."""
        if self._problem:
            return f"the sync line fails, and edges are lost until a restart: {self._problem}"
        if self._read_at_ns - self._dropped_at_ns < _DROP_WARNING_NS:
            return (
                f"edges of the sync line are dropped: there are more than {EDGES_PER_S_MAX} a "
                f"second, or {_KERNEL_EDGES_MAX} from frame to frame. Check cable and ground, or "
                "set sync.debounce_us"
            )
        return ""

    def read_edges(self, frame: AcquiredFrame) -> list[Edge]:
        """Read the edges since the last frame; before the first of a stream they are discarded."""
        elapsed_room = (frame.t_mono_ns - self._read_at_ns) * 1e-9 * EDGES_PER_S_MAX
        # A stall leaves a backlog in the kernel, which is no storm.
        self._room = max(min(self._room + elapsed_room, _EDGES_AT_ONCE_MAX), elapsed_room)
        self._read_at_ns = frame.t_mono_ns
        try:
            if self._problem or not self._request.wait_edge_events(0.0):
                return []
            events = self._request.read_edge_events()
        except OSError as error:
            self._problem = error.strerror or str(error)
            return []
        new: list[Edge] = []
        dropped = 0
        for event in events:
            # The kernel's number of 32 bits may wrap, and leaps over events that it dropped.
            step = (event.line_seqno - self._number) % 2**32
            self._number += step
            if frame.seq or event.timestamp_ns >= frame.t_mono_ns:
                is_rising = event.event_type is event.Type.RISING_EDGE
                new.append(Edge(self._number, event.timestamp_ns, is_rising))
                dropped += step - 1
        kept = new[max(0, len(new) - int(self._room)) :]
        self._room -= len(kept)
        if dropped := dropped + len(new) - len(kept):
            self.dropped_edges += dropped
            self._dropped_at_ns = frame.t_mono_ns
        return kept

    def close(self) -> None:
        """Release the line."""
        with suppress(OSError):
            self._request.release()


class EdgeReader:
    """Sink of a stream's frames that reads the edges before each.

    Args:
        line: line of the edges.
        sink: sink of edges and frames; None: they are not stored in flight.
    """

    def __init__(self, line: SyncInput, sink: EdgeSink | None) -> None:
        self._line = line
        self._sink = sink
        self._edges: list[Edge] = []

    def write_frame(self, frame: AcquiredFrame) -> None:
        """Read the edges up to now, and write them and then the frame to the sink."""
        edges = self._line.read_edges(frame)
        self._edges += edges
        if self._sink is not None:
            if edges:
                self._sink.write_edges(edges)
            self._sink.write_frame(frame)

    def take_batch(self) -> tuple[Edge, ...]:
        """Return the edges since the last call."""
        edges, self._edges = tuple(self._edges), []
        return edges


class RecordingLine:
    """Output line that is high while a session is recorded, or switches a lamp by its code.

    A thread switches the lamp at the edges of the code's bits, late as the system is busy.

    Args:
        scene: its section.
        line: its `output_line`.
        clock: clock of the code.

    Raises:
        MissingExtraError: gpiod is not installed.
        BusSetupError: the line is not there, in use, or forbidden.
    """

    def __init__(
        self,
        scene: SyncSection,
        line: int,
        clock: Clock = SystemClock(),  # noqa: B008
    ) -> None:
        with require_extra("gpio", "the recording line"):
            from gpiod import LineSettings
            from gpiod.line import Direction
        self._line = line
        self._clock = clock
        self._problem = ""
        self._is_recording = self._is_closed = False
        self._late_ns = deque[int](maxlen=_LATE_SWITCHES)
        low = LineSettings(direction=Direction.OUTPUT)
        self._request = _request_line(scene, line, low)
        self._blinking: Thread | None = None
        if scene.output == "code":
            make_code()  # not at the first edge
            self._blinking = Thread(target=self._blink, name="lamp", daemon=True)
            self._blinking.start()

    @property
    def warning(self) -> str:
        """Reason why the line may have another level; empty if it has the right one."""
        if self._problem:
            return f"the recording line cannot be driven: {self._problem}"
        late_ns = sum(self._late_ns) / max(1, len(self._late_ns))
        if self._is_recording and late_ns > LAMP_LATE_NS:
            return (
                f"the lamp is switched late; {late_ns * 1e-6:.0f} ms on average: films aligned by "
                "it are as much too early. Run less beside the node"
            )
        return ""

    def drive(self, *, high: bool) -> None:
        """Drive the line, the lamp from its next bit; a failure is a warning."""
        self._is_recording = high
        if self._blinking is None:
            self._set_level(high=high)

    def _blink(self) -> None:
        while not self._is_closed:
            edge_ns = (self._clock.now_ns() // BIT_NS + 1) * BIT_NS
            self._clock.sleep_until_ns(edge_ns)
            self._set_level(high=self._is_recording and is_lamp_on(self._clock.now_ns()))
            self._late_ns.append(self._clock.now_ns() - edge_ns)

    def _set_level(self, *, high: bool) -> None:
        from gpiod.line import Value

        try:
            self._request.set_value(self._line, Value.ACTIVE if high else Value.INACTIVE)
            self._problem = ""
        except OSError as error:
            self._problem = error.strerror or str(error)

    def close(self) -> None:
        """Drive the line low and release it."""
        self._is_closed = True
        if self._blinking is not None:
            self._blinking.join()
        self._set_level(high=False)
        with suppress(OSError):
            self._request.release()

"""Timing of faults of parts, multiplexers and wires, from scene files or injected by tests.

Their effects are in the emulated devices: the chips for tiles, `tca9548a` for multiplexers,
`FaultyWires` of `i2c_bus` for the two wires.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple

from devices.scene.emulation_sections import BUS_TARGET, DEFAULT_FAULT_RATE, FaultKind, FaultSection

_BEFORE_NS = 2**62  # later than any instant of the clock


class _Window(NamedTuple):
    """Begin and end of a fault, and its rate in between."""

    begin_ns: int
    end_ns: int
    rate: float


class FaultTiming:
    """One kind of fault of one target, active in time windows or by injection.

    Args:
        windows_s: begins and ends, in seconds of the scene.
        rates: probability in each window, for random faults; default: `RATE`.
    """

    def __init__(
        self, windows_s: Sequence[tuple[float, float]] = (), rates: Sequence[float] | None = None
    ) -> None:
        self._windows_s = tuple(windows_s)
        self._rates = (
            tuple(rates) if rates is not None else (DEFAULT_FAULT_RATE,) * len(self._windows_s)
        )
        # A fault at the scene's first instant exists before it.
        self._windows_ns = tuple(
            _Window(0, _BEFORE_NS, rate)
            for (begin, _), rate in zip(self._windows_s, self._rates, strict=True)
            if begin == 0.0
        )
        self._depth = 0
        self._was_injected = False
        self._is_new = False

    @property
    def is_possible(self) -> bool:
        """True if this fault can occur at any time, past or future."""
        return bool(self._depth or self._windows_ns or self._was_injected)

    def begin_scene_time(self, epoch_ns: int) -> None:
        """Begin the scene's time at this instant of the clock."""
        self._windows_ns = tuple(
            _Window(epoch_ns + round(begin * 1e9), epoch_ns + round(end * 1e9), rate)
            for (begin, end), rate in zip(self._windows_s, self._rates, strict=True)
        )

    def __call__(self, t_ns: int) -> bool:
        """Return whether the fault is active at `t_ns`."""
        if self._depth:
            return True
        if not self._windows_ns:  # fast path, for every START
            return False
        return any(window.begin_ns <= t_ns < window.end_ns for window in self._windows_ns)

    def get_rate(self, t_ns: int) -> float:
        """Return the largest rate of the windows active at `t_ns`; 0 without any."""
        by_hand = DEFAULT_FAULT_RATE if self._depth else 0.0
        if not self._windows_ns:  # fast path, for every byte
            return by_hand
        there = [w.rate for w in self._windows_ns if w.begin_ns <= t_ns < w.end_ns]
        return max(there, default=by_hand)

    def was_active_between(self, since_ns: int, t_ns: int) -> bool:
        """Return whether the fault was active at any time after `since_ns` until `t_ns`.

        An ended injection counts once, at the next call.
        """
        if self._depth or self._was_injected:
            self._was_injected = False
            return True
        return any(w.begin_ns <= t_ns and w.end_ns > since_ns for w in self._windows_ns)

    def began_between(self, since_ns: int, t_ns: int) -> bool:
        """Return whether the fault began after `since_ns` until `t_ns`; injections count once."""
        if self._is_new:
            self._is_new = False
            return True
        return any(since_ns < window.begin_ns <= t_ns for window in self._windows_ns)

    def end_at(self, t_ns: int) -> None:
        """End the fault at `t_ns`, as by a repair."""
        self._windows_ns = tuple(
            w._replace(end_ns=min(w.end_ns, t_ns)) if w.begin_ns <= t_ns else w
            for w in self._windows_ns
        )
        self._depth = 0

    @contextmanager
    def inject(self) -> Iterator[None]:
        """Context manager: inject the fault while the block runs, unless it is cleared."""
        self._depth += 1
        self._is_new = True
        try:
            yield
        finally:
            self._depth = max(0, self._depth - 1)
            self._was_injected = True


class SceneFaults:
    """Faults of a scene, by kind and target."""

    def __init__(self, scenes: Sequence[FaultSection]) -> None:
        self.is_any_possible = bool(scenes)
        """True if any fault can ever occur; checked first at every transfer."""
        self._scenes = scenes
        self._faults: dict[tuple[FaultKind, str], FaultTiming] = {}
        self._epoch_ns: int | None = None

    def get_fault(self, kind: FaultKind, target: str = BUS_TARGET) -> FaultTiming:
        """Return the fault of a kind and target: a tile's serial, a mux as "0x70", or the bus."""
        if (kind, target) not in self._faults:
            mine = [f for f in self._scenes if f.kind == kind and f.target == target]
            windows_s = [(f.t_s, f.t_s + f.duration_s) for f in mine]
            fault = FaultTiming(windows_s, [f.rate for f in mine])
            if self._epoch_ns is not None:
                fault.begin_scene_time(self._epoch_ns)
            self._faults[kind, target] = fault
        return self._faults[kind, target]

    def inject(self, kind: FaultKind, target: str) -> AbstractContextManager[None]:
        """Context manager: inject a fault while the block runs."""
        self.is_any_possible = True
        return self.get_fault(kind, target).inject()

    def begin_scene_time(self, epoch_ns: int) -> None:
        """Begin the scene's time at this instant of the clock."""
        self._epoch_ns = epoch_ns
        for fault in self._faults.values():
            fault.begin_scene_time(epoch_ns)


@dataclass
class PartFaults:
    """Faults of one part.

    `no_answer`: no acknowledge, as with RST low; registers and conversion go on. `unplugged`: no
    supply; afterwards its registers are as after power-up. `replaced`: unplugged, then another
    part in its place. `stale`: conversions never end. `slow`: they take longer, an MPL115A2's
    2.9 ms, still within its data sheet, a BMP581's 1.3 times its own, beyond it. `all_ones`: the
    part is lost between address and data, so that the line floats high.
    """

    no_answer: FaultTiming = field(default_factory=FaultTiming)
    unplugged: FaultTiming = field(default_factory=FaultTiming)
    replaced: FaultTiming = field(default_factory=FaultTiming)
    stale: FaultTiming = field(default_factory=FaultTiming)
    slow: FaultTiming = field(default_factory=FaultTiming)
    all_ones: FaultTiming = field(default_factory=FaultTiming)
    scene: SceneFaults | None = None
    """All faults of the scene; while none is possible, the others are not evaluated."""

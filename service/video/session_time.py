"""Time of a session for its films: the node's clock, the server's, and contacts, on one axis.

The session's time is `t_ns` of its frames, by the node's date, on the session's time axis.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from devices.errors import FileFormatError, StateError, UsageError
from service.sessions.stances import load_stances
from service.video.alignment import Instants
from storage.clock.table import ClockTable
from storage.schema import UNKNOWN_T_NS
from storage.sessions.metadata import load_clock_table
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import PartSpan, TimeAxis

_ITERATIONS = 3
"""Steps to invert the offset of two clocks: it changes by 500 ppm of a step at most."""
_CONTACT_SIGMA_S = 0.01
"""Uncertainty of a contact's begin whose force rises too slowly to state one."""


class SessionTime(NamedTuple):
    """Spans of a session's parts and their clocks."""

    path: Path
    begin_t_ns: int
    end_t_ns: int
    period_ns: float
    spans: tuple[PartSpan, ...]
    axis: TimeAxis
    clock: ClockTable | None
    has_lamp: bool
    """True: the node's scene has a lamp that blinks the code."""

    def get_mono_offset_ns(self, span: PartSpan) -> int:
        """Return the session's time minus `t_mono_ns` of a part."""
        return span.t_ns[0] - span.t_mono_ns[0] + self.axis.get_shift_ns(span.number)

    def convert_server_time(self, t_server_ns: int) -> tuple[int, int]:
        """Convert an instant of the server's UTC to the session's time, with its bound, in ns.

        Parts whose clock was never compared with the server's count as far away.
        """
        found: list[tuple[int, int, int]] = []
        for span in self.spans:
            offset_ns = span.t_ns[0] - span.t_mono_ns[0]
            t_ns = t_server_ns
            for _ in range(_ITERATIONS):
                server_ns, bound_ns = self._to_server_time(t_ns - offset_ns, t_ns, span.number)
                if server_ns == UNKNOWN_T_NS:
                    break
                t_ns += t_server_ns - server_ns
            else:
                away_ns = max(span.t_ns[0] - t_ns, t_ns - span.t_ns[1], 0)
                found.append((away_ns, t_ns + self.axis.get_shift_ns(span.number), bound_ns))
        _, t_ns, bound_ns = min(found)
        return t_ns, bound_ns

    def get_any_server_time(self) -> int:
        """Return the server's UTC at the begin of the first part whose clock was compared.

        Raises:
            StateError: the node's clock was never compared with the server's.
        """
        for span in self.spans:
            server_ns, _ = self._to_server_time(span.t_mono_ns[0], span.t_ns[0], span.number)
            if server_ns != UNKNOWN_T_NS:
                return server_ns
        raise StateError(
            "the node's clock was not compared with a server's, whose time the film shows",
            where=str(self.path.parent),
            remedy="Align by light, contact or hand",
        )

    def _to_server_time(self, t_mono_ns: int, t_ns: int, part: int) -> tuple[int, int]:
        if self.clock is None:
            return UNKNOWN_T_NS, UNKNOWN_T_NS
        columns = self.clock.compute_server_time_columns_or_unknown(
            np.array([t_mono_ns]), np.array([t_ns]), np.array([part])
        )
        return int(columns["t_server_ns"][0]), int(columns["t_server_uncertainty_ns"][0])

    def load_contacts(self) -> Instants:
        """Load the begins of the session's contacts, in s from its begin.

        Raises:
            UnknownError: it has no estimates.
            FileFormatError: it is damaged.
        """
        table = load_stances(self.path.parent)
        begun = table["begun"].to_numpy()
        part, t_ns = table["part"].to_numpy()[begun], table["begin_t_ns"].to_numpy()[begun]
        sigma_s = table["duration_sigma_s"].to_numpy()[begun] / np.sqrt(2.0)
        # The foot was put down between the frame before and the first one.
        on_axis_ns = self.axis.shift_to_axis(t_ns, part) - self.begin_t_ns - self.period_ns / 2
        return Instants(
            np.asarray(1e-9 * on_axis_ns, dtype=np.float64),
            np.where(np.isnan(sigma_s), _CONTACT_SIGMA_S, sigma_s),
            1e-9 * (self.end_t_ns - self.begin_t_ns),
        )


def read_session_time(frames: Path) -> SessionTime:
    """Read the time of a sealed session.

    Raises:
        FileFormatError: it is damaged, or has no frames.
    """
    with SealedFileReader(frames, only_slices=True) as reader:
        spans = tuple(reader.read_part_spans())
        if not spans:
            raise FileFormatError("the session has no frames", where=str(frames))
        begin_t_ns, end_t_ns = reader.read_span_on_axis_ns()
        try:
            clock = load_clock_table(reader)
        except UsageError:  # a node alone
            clock = None
        return SessionTime(
            path=frames,
            begin_t_ns=begin_t_ns,
            end_t_ns=end_t_ns,
            period_ns=1e9 / reader.info.nominal_rate_hz,
            spans=spans,
            axis=reader.time_axis,
            clock=clock,
            has_lamp=_has_lamp(reader.notes.get("scene")),
        )


def _has_lamp(scene_content: object) -> bool:
    sync = scene_content.get("sync") if isinstance(scene_content, dict) else None
    return isinstance(sync, dict) and sync.get("output") == "code"

"""Control of a stream's tares: from its lead, in flight, by hand; with warnings.

One controller per stream, updated after every message of frames; times are those of the frames.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import takewhile

import numpy as np

from devices.errors import FileFormatError, TareError
from devices.flags import FrameFlag
from devices.frames import ArrayInfo, FrameBatch
from service.estimation.pipeline.plan import TARE_OLD_NS
from service.estimation.tare.automatic import (
    RECOVERY_NS,
    TARE_INTERVAL_MIN_NS,
    WINDOW_NS,
    FlightTareResult,
)
from service.estimation.tare.tare import (
    Tare,
    compute_sealed_gas_shift_kpa,
    compute_warming_k,
    has_temperature_changed,
)
from service.protocol.live import AutoTareState
from service.server.estimates.live_estimator import LiveEstimator
from service.sessions.tares import RecordedTare, TareHistory
from storage.intervals import Intervals
from storage.journal.journal import Journal

FLIGHT_CHECK_PERIOD_NS = 5_000_000_000
"""Period of the search for a flight tare, which costs some milliseconds."""
LEAD_TIMEOUT_NS = 10_000_000_000
"""Timeout for missing frames of a lead after its end."""
_BY_HAND = "lift the foot, hold it still, and tare"


class TareController:
    """Controller of the tares of one stream.

    Args:
        info: array of the stream.
        live: estimator that uses the tare in force.
        history: history of the node's tares.
        automatic: True: tares in flight are allowed.
    """

    def __init__(
        self, info: ArrayInfo, live: LiveEstimator, history: TareHistory, *, automatic: bool
    ) -> None:
        self._info = info
        self._live = live
        self._history = history
        self._automatic = automatic
        self._is_lead_done = False  # and evaluated
        self._has_seen_lead = False
        self._lead_end_t_ns: int | None = None
        self._lead_problem: str | None = None
        self._has_other_tare = False  # in this stream, other than by its lead
        self._flight_warning: str | None = None
        self._next_check_t_ns = 0

    @property
    def auto_tare_state(self) -> AutoTareState:
        """State of automatic tares: off by the scene, or paused by an undo."""
        if not self._automatic:
            return "off"
        return "paused" if self._history.is_automatic_paused(self._info) else "on"

    @property
    def missing_tare_reason(self) -> str | None:
        """Reason why there is no tare, or why it is not of this stream."""
        if self._lead_problem is not None:
            return f"the lead gave no tare ({self._lead_problem}): {_BY_HAND}"
        if self._history.is_tare_lost(self._info):
            return f"the tare in force is damaged and lost, so no force is known: {_BY_HAND}"
        return (
            f"not tared: {_BY_HAND}"
            if self._history.tare_in_force_unless_lost(self._info) is None
            else None
        )

    def list_reasons_to_tare_again(self) -> list[str]:
        """Return the reasons why the tare in force may no longer fit, as text."""
        tare, newest_t_ns = self._live.tare_in_use_unless_lost, self._live.newest_t_ns
        if tare is None or newest_t_ns is None:
            return []
        texts = []
        age_ns = newest_t_ns - tare.t_ns
        if age_ns > TARE_OLD_NS:
            texts.append(f"tared {age_ns / 60e9:.0f} min ago: {_BY_HAND}")
        if (
            "temperature" not in self._info.models
            and (warmed := self._temperature_warning(tare)) is not None
        ):
            texts.append(warmed)
        if self._flight_warning is not None:
            texts.append(self._flight_warning)
        return texts

    def _temperature_warning(self, tare: Tare) -> str | None:
        temperature_raw = self._live.mean_recent_temperature_raw()
        bears = np.array([not tile.reference for tile in self._info.tiles])
        counts_per_kelvin = self._live.counts_per_kelvin
        tiles = np.flatnonzero(
            has_temperature_changed(tare, temperature_raw, counts_per_kelvin) & bears
        )
        if not len(tiles):
            return None
        warmer = compute_warming_k(tare, temperature_raw, counts_per_kelvin)
        mean_k = float(warmer[tiles].mean())
        who = f"tile {self._info.serials[tiles[0]]} is" if len(tiles) == 1 else "the tiles are"
        shift_n = self._live.grf_shift_n(compute_sealed_gas_shift_kpa(tare, warmer))
        effect = "" if shift_n is None else f", about {shift_n:+.1f} N on the foot"
        return (
            f"{who} {abs(mean_k):.1f} K {'warmer' if mean_k > 0 else 'colder'} than when tared"
            f"{effect}: {_BY_HAND}"
        )

    def tare_by_hand(self, reason: str = "") -> RecordedTare:
        """Tare from an unloaded interval of the last seconds, and put the tare in force.

        Raises:
            TareError: the foot was loaded, or there is nothing to tare.
            StorageError: the tare cannot be stored.
        """
        recorded = self._history.store_tare_in_force(
            self._live.compute_unloaded_tare(), self._info, reason
        )
        self._put_in_force(recorded)
        return recorded

    def undo_tare(self, tare_id: str) -> None:
        """Undo a tare. If it was in force, the one before it is again, and automatic tares pause.

        Raises:
            UnknownError, StorageError: as for `TareHistory.undo_tare`.
        """
        self._history.undo_tare(tare_id)
        self._flight_warning = None
        self._live.set_tare(self._history.tare_in_force_or_lost(self._info))

    def store_lead_or_flight_tare_if_due(
        self, journal: Journal | None, get_obtainable: Callable[[], Intervals]
    ) -> None:
        """Tare from a lead that has ended, or in flight, if that is due.

        Args:
            journal: journal of the stream.
            get_obtainable: returns the frames that the node can still send, which is slow.

        Raises:
            StorageError: a tare cannot be stored; it is not in force then, and retried.
        """
        if self._live.calibration is None:
            return
        if not self._is_lead_done and journal is not None:
            self._tare_from_lead(journal, get_obtainable)
        if self._is_flight_check_due() and self.auto_tare_state == "on":
            self._tare_in_flight()

    def _tare_from_lead(self, journal: Journal, get_obtainable: Callable[[], Intervals]) -> None:
        newest = self._live.newest_batch
        if newest is None or newest.frame_flags[-1] & FrameFlag.LEAD:
            self._has_seen_lead |= newest is not None
            return
        # From the journal: after a lost link frames come in any order.
        seq, t_ns = int(newest.seq[-1]), int(newest.t_ns[-1])
        self._lead_end_t_ns = self._lead_end_t_ns or t_ns
        lacks = journal.stored.missing_in(min(get_obtainable().first or 0, seq), seq)
        if lacks and t_ns - self._lead_end_t_ns < LEAD_TIMEOUT_NS:
            return
        try:
            batches = journal.read_frames(0, seq)
            begin = [*takewhile(lambda batch: batch.frame_flags[0] & FrameFlag.LEAD, batches)]
        except FileFormatError as error:
            self._is_lead_done, self._lead_problem = True, str(error)
            return
        if not begin:
            self._is_lead_done = True
            return
        lead = FrameBatch.concatenate(begin)
        if self._has_other_tare:
            self._is_lead_done = True
            return
        try:
            tare = self._live.compute_lead_tare(lead)
        except TareError as error:
            self._is_lead_done, self._lead_problem = True, error.what
            return
        keys = {(t.tare.source, t.tare.t_ns) for t in self._history.all_tares_with_undone}
        # In the history, or lost: the server was restarted, and another tare may have followed.
        is_older = not self._has_seen_lead and self._history.may_have_lost_tare_taken_at(tare.t_ns)
        if ("lead", tare.t_ns) not in keys and not is_older:
            self._live.set_tare(self._history.store_tare_in_force(tare, self._info).tare)
        self._is_lead_done = True

    def _is_flight_check_due(self) -> bool:
        live = self._live
        t_ns = live.newest_t_ns
        if t_ns is None or t_ns < self._next_check_t_ns:
            return False
        if live.tare_in_use_unless_lost is not None:
            free_t_ns = live.airborne_since_t_ns
            if t_ns - live.tare_in_use_unless_lost.t_ns < TARE_INTERVAL_MIN_NS or free_t_ns is None:
                return False
            if t_ns - free_t_ns < RECOVERY_NS + WINDOW_NS:
                return False
        self._next_check_t_ns = t_ns + FLIGHT_CHECK_PERIOD_NS
        return True

    def _tare_in_flight(self) -> None:
        anchor = self._history.last_not_in_flight_or_oldest(self._info)
        found: FlightTareResult = self._live.find_ongoing_flight_or_first_tare(
            anchor.tare if anchor is not None else None
        )
        self._flight_warning = found.rejection
        if found.tare is not None:
            self._put_in_force(
                self._history.store_tare_in_force(found.tare, self._info, found.reason)
            )

    def _put_in_force(self, recorded: RecordedTare) -> None:
        self._lead_problem = self._flight_warning = None
        self._has_other_tare = True
        self._live.set_tare(recorded.tare)

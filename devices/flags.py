"""Flags of frames, tiles and estimates: one table of bits, titles and meanings.

Column texts, the tables in docs/ and `web/common/flags.js` are generated from it
(`FOOTTILE_WRITE_MAP=1 pytest tests/test_flags.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag, StrEnum


class TileFlag(IntFlag):
    """Flags of a tile in a frame; bits of `FrameBatch.tile_flags`."""

    NO_ANSWER = 1
    STALE = 2
    RETRIED = 4
    IMPLAUSIBLE = 8
    OVER_RANGE = 16
    NOT_CONVERTED = 32

    UNUSABLE = NO_ANSWER | STALE | IMPLAUSIBLE | NOT_CONVERTED
    """Mask of the flags without a usable pressure."""


class FrameFlag(IntFlag):
    """Flags of a frame; bits of `FrameBatch.frame_flags`."""

    OVERRUN = 1
    SERVO_STALE = 2
    BUS_FAULT = 4
    LEAD = 8
    NEW_ARRAY_INFO = 16
    SERVO_TURN_UNKNOWN = 32


CONTACT_UNKNOWN = 255
"""Value of an estimate's `contact` where it is unknown."""


class EstimateFlag(IntFlag):
    """Flags of an estimated frame; bits of `Estimates.estimate_flags`."""

    SATURATED = 1
    EXTRAPOLATED = 2
    OUTLIER_REPLACED = 4
    GAP = 8
    COP_MASKED = 16
    TILE_MISSING = 32
    ASSUMED_SCALE = 64
    TARE_OLD = 128
    OVER_RATED = 256
    TARE_LOST = 512
    AFTER_SATURATION = 1024
    STUCK = 2048
    CLIPPED = 4096
    BASELINE_LOST = 8192
    HISTORY_UNKNOWN = 16384


class Severity(StrEnum):
    """Effect of a flag on the value that it belongs to."""

    NOTE = "note"  # none
    DOUBT = "doubt"  # less certain
    BOUND = "bound"  # only a bound is known
    UNKNOWN = "unknown"  # not known


@dataclass(frozen=True)
class FlagText:
    """Texts of a flag.

    Attributes:
        title: short text of lists and legends; empty where pages show it otherwise.
        meaning: full text of the documents.
        severity: effect on the value.
    """

    title: str
    meaning: str
    severity: Severity = Severity.NOTE


TILE_FLAGS: Mapping[TileFlag, FlagText] = {
    TileFlag.NO_ANSWER: FlagText(
        "no answer", "it did not acknowledge, or is looked for: no counts", Severity.UNKNOWN
    ),
    TileFlag.STALE: FlagText(
        "stale", "the node read ten repeats of its counts: kept, not used", Severity.UNKNOWN
    ),
    TileFlag.RETRIED: FlagText("", "it took a second attempt, or a third reading: good"),
    TileFlag.IMPLAUSIBLE: FlagText(
        "implausible",
        "no part gives this, or it could not be confirmed, or another part answers: counts are "
        "kept, not used",
        Severity.UNKNOWN,
    ),
    TileFlag.OVER_RANGE: FlagText(
        "",
        "outside the chip's rated range or at the end of its counts: good as a lower bound",
        Severity.BOUND,
    ),
    TileFlag.NOT_CONVERTED: FlagText(
        "not converted",
        "zeros after power-up, or no finished conversion in this frame: not used",
        Severity.UNKNOWN,
    ),
}

FRAME_FLAGS: Mapping[FrameFlag, FlagText] = {
    FrameFlag.BUS_FAULT: FlagText(
        "bus fault", "the bus itself failed, not one tile", Severity.UNKNOWN
    ),
    FrameFlag.OVERRUN: FlagText(
        "node late: no frames sampled just before",
        "the frame began after its slot; the slots before it were not sampled",
    ),
    FrameFlag.SERVO_STALE: FlagText(
        "servo angle stale", "the newest servo position is older than it should be"
    ),
    FrameFlag.SERVO_TURN_UNKNOWN: FlagText(
        "servo turn unknown",
        "the servo restarted or its count jumped: the position may be off by whole turns",
    ),
    FrameFlag.LEAD: FlagText(
        "unloaded lead-in", "the frame precedes a load trace: the foot is unloaded"
    ),
    FrameFlag.NEW_ARRAY_INFO: FlagText(
        "array scanned again", "the array was identified again before this frame"
    ),
}

ESTIMATE_FLAGS: Mapping[EstimateFlag, FlagText] = {
    EstimateFlag.SATURATED: FlagText(
        "tile saturated",
        "a tile is beyond its calibrated range (gas settled) or its chip's: force is a bound, no "
        "`grf_n`",
        Severity.BOUND,
    ),
    EstimateFlag.CLIPPED: FlagText(
        "tile clipped below its range",
        "a tile is at an edge below its chip's range where its readings end: force is a lower "
        "bound",
        Severity.BOUND,
    ),
    EstimateFlag.TILE_MISSING: FlagText(
        "tile missing",
        "a tile gave no pressure, or one 10 kPa below its baseline: no `grf_n`, but "
        "`grf_lower_bound_n`",
        Severity.UNKNOWN,
    ),
    EstimateFlag.STUCK: FlagText(
        "tile stuck",
        "the estimator sees a count repeated for longer than noise allows: force is unknown",
        Severity.UNKNOWN,
    ),
    EstimateFlag.TARE_LOST: FlagText(
        "tare lost",
        "the tare in force is damaged on disk: no pressure and no force until the next one",
        Severity.UNKNOWN,
    ),
    EstimateFlag.EXTRAPOLATED: FlagText(
        "a tile below its calibrated range (suction or old tare)",
        "a tile is below its calibrated range: suction, or a tare that no longer holds",
        Severity.DOUBT,
    ),
    EstimateFlag.TARE_OLD: FlagText(
        "tare in doubt",
        "tare over half an hour old, or a chip 0.75 K off since, without the model `temperature`",
        Severity.DOUBT,
    ),
    EstimateFlag.BASELINE_LOST: FlagText(
        "zero of a tile has dropped",
        "below its baseline, leaking, or 0.4 kPa of uncorrected temperature since the tare: in "
        "sigma",
        Severity.DOUBT,
    ),
    EstimateFlag.AFTER_SATURATION: FlagText(
        "less certain: a tile saturated or not read just before",
        "an unseen load (saturation, or no data for 50 ms) still adds more to sigma than noise",
        Severity.DOUBT,
    ),
    EstimateFlag.HISTORY_UNKNOWN: FlagText(
        "less certain: loads before the first frame are not known",
        "estimates began under load, and loads before that still add more to sigma than noise",
        Severity.DOUBT,
    ),
    EstimateFlag.OVER_RATED: FlagText(
        "above the rated pressure",
        "a tile is above its chip's rated range, but within its calibration",
        Severity.DOUBT,
    ),
    EstimateFlag.OUTLIER_REPLACED: FlagText(
        "outlier replaced", "an outlier was replaced, by the model `denoise`"
    ),
    EstimateFlag.ASSUMED_SCALE: FlagText(
        "scale assumed", "the calibration's scale is assumed: do not trust the newtons"
    ),
    EstimateFlag.GAP: FlagText("", "frames are missing before this one"),
    EstimateFlag.COP_MASKED: FlagText(
        "",
        "no COP: no contact, GRF below 5 sigma, sigma over 3 mm, saturated, or off the hull "
        "(3 sigma)",
    ),
}


def list_bits(flags: type[IntFlag]) -> str:
    """Return bits and names of flags, by bit, as a column's text: `1 overrun, 2 servo_stale`."""
    return ", ".join(f"{flag.value} {str(flag.name).lower()}" for flag in flags)

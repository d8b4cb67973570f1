"""What a calibration's recordings were like: where they ended, how warm, how repeats agreed."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from service.estimation.effects import CalibrationPart


class BandPoint(CalibrationPart):
    """The curve at one pressure, with half widths of its 95 % bands."""

    gauge_kpa: float
    force_n: float
    mean_n: float = Field(ge=0)
    """Of the mean curve."""
    new_loading_n: float = Field(ge=0)
    """Of a reading in a single new loading."""


class BenchFacts(CalibrationPart):
    """Facts about the slow strokes that a curve was fitted to."""

    recordings: int = Field(ge=1)
    """Files with slow strokes of the tile."""
    end_n: float
    """Reference force where the range ends, mean over repeats."""
    end_absolute_kpa: float
    """Pressure where the range ends: baseline and range."""
    spare_kpa: float
    """What of the chip's 115 kPa is left there; negative: beyond its rating."""
    ended_by: Literal["load", "chip"]
    """"load": the spindle turned back, and the tile would have gone on; "chip": its reading went no
    further, by wrapping or standing still."""
    tadc_counts: float | None
    """Chip's temperature in counts, unloaded; None: not recorded."""
    degc: float | None
    """The same, indicative: good to a few degrees."""
    r2_of_mean: float
    """Of the cubic to the mean of all repeats and both branches, as the paper states it."""
    repeat_gains: tuple[float, ...]
    """Force of each repeat over that of the curve."""
    baseline_drift_kpa: float = Field(ge=0)
    """Greatest change of the unloaded pressure between repeats of a file, from the second on."""
    band_95: tuple[BandPoint, ...]
    """At ten equal steps from zero to the end of the range."""

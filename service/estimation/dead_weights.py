"""Dead weights: parsing of their texts, and the least number for a curve."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from devices.errors import CalibrationError, UsageError

STANDARD_GRAVITY_M_S2 = 9.80665
GRAVITY_SIGMA = 0.0015
"""Relative uncertainty of gravity: 0.5 % between pole and equator, 0.1 % by height."""
TOLERANCE_PERCENT = 1.0
"""Tolerance of a weight without a stated one."""
HOLDS_MIN = 5
LEVELS_MIN = 4
"""Least number of different weights: of three a single one would determine the curve's shape."""
LEVEL_RATIO_MIN = 1.1
"""Least ratio of two different weights."""
_WEIGHT = re.compile(
    r"(?P<size>\d{1,6}(?:[.,]\d{1,6})?)\s?(?P<unit>g|kg|n)"
    r"(?:\s?(?:\+-|±)\s?(?P<off>\d{1,2}(?:[.,]\d{1,4})?)\s?%)?",
    re.IGNORECASE,
)
_SEPARATOR = re.compile(r";|,(?!\d)|(?<!\d),")
"""Between weights; a comma between digits is a decimal comma."""
_THOUSANDS = re.compile(r"[1-9]\d*,\d{3}(?!\d)")
"""Comma of thousands, or a decimal comma."""
_UNITS = {"g": "g", "kg": "kg", "n": "N"}
_NEWTONS = {"g": 1e-3 * STANDARD_GRAVITY_M_S2, "kg": STANDARD_GRAVITY_M_S2, "N": 1.0}
_HEAVIEST_N = 1000.0


@dataclass(frozen=True)
class DeadWeight:
    """Known force with its relative standard uncertainty."""

    force_n: float
    relative_sigma: float


def parse_weight(text: str) -> DeadWeight | None:
    """Parse a weight such as `500 g`, `0,5 kg +-1 %` or `4.9 N`; None: the text is no weight."""
    found = _WEIGHT.fullmatch(text.strip())
    if found is None or _THOUSANDS.match(found["size"]):
        return None
    unit = _UNITS[found["unit"].lower()]
    force_n = _parse_number(found["size"]) * _NEWTONS[unit]
    if not 0.0 < force_n <= _HEAVIEST_N:
        return None
    # A tolerance bounds the error: its standard uncertainty is that of a uniform distribution.
    percent = TOLERANCE_PERCENT if found["off"] is None else _parse_number(found["off"])
    gravity = 0.0 if unit == "N" else GRAVITY_SIGMA
    return DeadWeight(force_n, float(np.hypot(0.01 * percent / np.sqrt(3.0), gravity)))


def _parse_number(text: str) -> float:
    return float(text.replace(",", "."))


def check_and_label_weights(
    texts: Sequence[str], default_tolerance_percent: float
) -> tuple[str, ...]:
    """Check that weights suffice for a curve; label them `500 g +-0.5 %`, a stated tolerance stays.

    Args:
        texts: each of one weight, or of several with commas or semicolons between.
        default_tolerance_percent: tolerance of a weight that states none.

    Raises:
        UsageError: a text is no weight, or there are too few for a curve.
    """
    labels, forces_n = [], []
    for text in (one.strip() for line in texts for one in _SEPARATOR.split(line)):
        if not text:
            continue
        label = text if "%" in text else f"{text} +-{round(default_tolerance_percent, 4):g} %"
        found, weight = _WEIGHT.fullmatch(label.strip()), parse_weight(label)
        if found is None or weight is None:
            raise UsageError(
                f"{text[:40]!r} is no weight",
                expected="masses or forces, as 200 g, 1.5 kg or 4,9 N; with a decimal comma, not "
                "one of thousands",
            )
        size, off = found["size"].replace(",", "."), found["off"].replace(",", ".")
        labels.append(f"{size} {_UNITS[found['unit'].lower()]} +-{off} %")
        forces_n.append(weight.force_n)
    try:
        check_enough_distinct_weights(forces_n)
    except CalibrationError as error:
        raise UsageError(error.what, expected=error.expected, remedy=error.remedy) from error
    return tuple(labels)


def check_enough_distinct_weights(forces_n: Sequence[float], where: str = "") -> None:
    """Reject weights that are too few, or too similar, for a curve.

    Raises:
        CalibrationError: there are too few, or too few different ones.
    """
    levels: list[float] = []
    for force_n in sorted(forces_n):
        if not levels or force_n > LEVEL_RATIO_MIN * levels[-1]:
            levels.append(force_n)
    if len(forces_n) < HOLDS_MIN or len(levels) < LEVELS_MIN:
        raise CalibrationError(
            f"{len(forces_n)} weights on the tile, {len(levels)} of them different",
            where=where,
            expected=f"{HOLDS_MIN} or more, {LEVELS_MIN} of them different by a tenth or more",
            remedy="Put more weights on it; two together are a third one",
        )

"""Separation of the tiles' sample delays from the reference's delay.

A rig measures each tile against the reference, and so the sum of two delays. Differences between
tiles are the tiles' own. The mean may be the tiles' or the reference's; prior knowledge of the
reference divides it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from service.estimation.effects import Effects, Parameter
from service.estimation.fitting.dome_model import SAMPLE_DELAY_SIGMA_S

DEFAULT_REFERENCE_DELAY = Parameter(value=0.0, sigma=0.0005)
"""Delay of a load cell behind an amplifier of some 300 Hz."""


def separate_delays(effects: Sequence[Effects], reference_delay: Parameter) -> list[Effects]:
    """Return the effects of tiles of one rig with their own sample delays, in the same order.

    The mean over tiles is divided between tiles and reference in proportion to their variances; its
    remaining uncertainty is common to all tiles.

    Args:
        effects: of the tiles, with `late_s` as measured against the reference.
        reference_delay: of the reference.
    """
    seen = [each.late_s.value for each in effects if each.late_s is not None]
    if not seen:
        return list(effects)
    shared_s = float(np.mean(seen)) - reference_delay.value
    of_tiles = SAMPLE_DELAY_SIGMA_S**2 / (SAMPLE_DELAY_SIGMA_S**2 + reference_delay.sigma**2)
    reference_s = reference_delay.value + (1.0 - of_tiles) * shared_s
    common_s = float(np.sqrt(of_tiles)) * reference_delay.sigma
    return [
        each
        if each.late_s is None
        else each.model_copy(
            update={
                "late_s": Parameter(value=each.late_s.value - reference_s, sigma=each.late_s.sigma),
                "late_common_s": common_s,
                "reference_late_s": reference_s,
            }
        )
        for each in effects
    ]

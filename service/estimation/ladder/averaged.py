"""`denoise` on a foot: windows of the sum of all tiles bound those of each.

Tiles bear the same load. What shakes it, or lets it go, is above the noise of their sum before it
is above the noise of any of them, and what each would smooth away a little of is missing in the GRF
as often as there are tiles.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats, Ints, Times
from devices.compiled import compiled
from service.estimation.ladder.lower import ApparentForces
from service.estimation.ladder.plan import EstimationPlan
from service.estimation.models import denoise


def averaged(
    plan: EstimationPlan, apparent: ApparentForces, first: int, stop: int
) -> tuple[Floats, Floats, Floats, Times]:
    """Apparent forces in frames `first` to `stop` without their noise; arrays (n, bearing tiles).

    Returns:
        Forces; the standard deviations that are left of their noise; what averages smooth away of
        the load, as far as the sum of tiles shows it; and the instants that they are of.
    """
    # A lower bound would be averaged with what is no bound.
    usable_n = np.where(apparent.beyond, np.nan, apparent.apparent_n)
    noise_n, sampled_ns, t_ns = apparent.noise_n, apparent.sampled_ns, apparent.t_mono_ns
    asked_ns = np.broadcast_to(t_ns[:, None], sampled_ns.shape) if plan.ladder.skew else sampled_ns
    tiles = usable_n.shape[1]
    # Without look-ahead the next frame is not there, and may be of the same instant.
    look_ns = plan.look_ns if plan.waits else -1

    def averages(
        forces_n: Floats,
        noises_n: Floats,
        at_ns: tuple[Times, Times],
        noise_left: Floats,
        within: Ints,
    ) -> tuple[Floats, Floats, Floats, Floats, Ints]:
        return denoise.denoised(
            np.ascontiguousarray(forces_n),
            np.ascontiguousarray(noises_n),
            np.ascontiguousarray(at_ns[0]),
            np.ascontiguousarray(t_ns),
            np.ascontiguousarray(at_ns[1]),
            np.ascontiguousarray(apparent.run),
            first,
            stop,
            look_ns,
            denoise.PAST_NS,
            denoise.REACHES,
            denoise.AGREE,
            noise_left,
            within,
        )

    within = denoise.anywhere(stop - first, len(t_ns))
    if tiles > 1:
        # Of offsets: so many instants may add up to more than there are bits.
        mean_ns = [
            t_ns[:, None] + (each - t_ns[:, None]).sum(axis=1, keepdims=True) // tiles
            for each in (sampled_ns, asked_ns)
        ]
        *_, within = averages(
            summed(usable_n)[:, None],
            np.sqrt(summed(noise_n**2))[:, None],
            (mean_ns[0], mean_ns[1]),
            plan.noise_left.mean(axis=0, keepdims=True),
            within,
        )
    force_n, left, bend_n, of_bend, _ = averages(
        usable_n, noise_n, (sampled_ns, asked_ns), plan.noise_left, within
    )
    single_n = noise_n[first:stop]
    bend_n = denoise.shared_bend(bend_n, single_n * np.sqrt(of_bend))
    force_n = np.where(np.isnan(force_n), apparent.apparent_n[first:stop], force_n)
    noise_n = single_n * np.sqrt(np.where(np.isnan(left), 1.0, left))
    return force_n, noise_n, bend_n, np.ascontiguousarray(asked_ns[first:stop])


@compiled
def summed(values: Floats) -> Floats:
    """Sum over tiles, (n,)."""
    n, tiles = values.shape
    total = np.zeros(n)
    for i in range(n):
        for tile in range(tiles):
            total[i] += values[i, tile]
    return total

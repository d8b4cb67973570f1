"""Model sets that are compared: built up one model at a time, and the full set without each one.

The first show the gain of each model for its run time, the second show its effect in the full set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from service.estimation.ladder.chosen import MODELS

FOUNDATION = ("unwrap", "static")
"""First model set: the models that every force needs."""
BY_WHAT_MATTERS = ("denoise", "skew", "gas", "rubber", "hysteresis", "temperature", "ambient")


@dataclass(frozen=True)
class Rung:
    """Model set, and its relation to the others.

    Attributes:
        label: short name for tables and plots.
        models: the models, in the order of `MODELS`.
        is_built_up: True for the first set and each set with one model more than the set before.
        adds: model that it adds to the set before; None for the first and ablated sets.
        lacks: the one model of the full set that is missing in it; None otherwise.
        spare: model that it adds to the full set.
        is_default: True for the scene's full set.
    """

    label: str
    models: tuple[str, ...]
    is_built_up: bool
    adds: str | None
    lacks: str | None
    is_default: bool
    spare: str | None = None


def rungs(
    models_of_scene: Sequence[str],
    existing: Sequence[str] = MODELS,
    offered: Sequence[str] = (),
) -> tuple[Rung, ...]:
    """List the model sets to compare for a scene, without duplicates.

    First the built-up ones, ending with the scene's full set, then the full set without each of its
    models, then the full set with each further model. Unknown models are left out; see
    `absent`.

    Args:
        models_of_scene: models of the scene, with `static`.
        existing: all models, in order of application.
        offered: further models that array and calibration support.
    """
    whole = tuple(name for name in existing if name in models_of_scene)
    later = [name for name in existing if name not in (*FOUNDATION, *BY_WHAT_MATTERS)]
    order = [name for name in (*BY_WHAT_MATTERS, *later) if name in whole]
    less = {tuple(m for m in whole if m != name): name for name in whole if name != "static"}
    built: list[Rung] = []
    chosen = [name for name in FOUNDATION if name in whole]
    for added in (None, *order):
        chosen += [] if added is None else [added]
        models = tuple(name for name in existing if name in chosen)
        label = "+".join(models) if added is None else f"+{added}"
        if models == whole:
            label = f"{label} (whole)" if added is None else f"whole ({label})"
        built.append(Rung(label, models, True, added, less.get(models), models == whole))
    seen = {rung.models for rung in built}
    ablated = [
        Rung(f"whole -{name}", models, False, None, name, False)
        for models, name in less.items()
        if models not in seen
    ]
    more = [
        Rung(
            f"whole +{name}",
            tuple(m for m in existing if m in (*whole, name)),
            is_built_up=False,
            adds=None,
            lacks=None,
            is_default=False,
            spare=name,
        )
        for name in existing
        if name in offered and name not in whole
    ]
    return (*built, *ablated, *more)


def absent(models_of_scene: Sequence[str], existing: Sequence[str] = MODELS) -> tuple[str, ...]:
    """Return the models of a scene that do not exist."""
    return tuple(name for name in models_of_scene if name not in existing)

"""Which ladders of models are compared: built up one model at a time, and the whole less each one.

The first shows what a model buys for its time, the second what would be left without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from service.estimation.ladder.chosen import MODELS

FOUNDATION = ("unwrap", "static")
"""The first rung: what every force needs."""
BY_WHAT_MATTERS = ("denoise", "skew", "gas", "rubber", "hysteresis", "temperature", "ambient")


@dataclass(frozen=True)
class Rung:
    """One ladder of models, and its place among the others.

    Attributes:
        label: short name for tables and plots.
        models: the models, in the order of `MODELS`.
        is_built_up: it is the first rung, or one more than the rung before; else it is only there
            as the whole ladder less a model.
        adds: what it has more than the rung before it; None for the first and what is not built up.
        lacks: what the whole ladder has more, if that is one model that can be left out.
        spare: what it has more than the whole ladder: a model that the scene does without.
        is_default: it is the scene's whole ladder.
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
    """The ladders to compare for a scene, each once.

    First those that are built up, ending with the scene's whole ladder, then those that lack one
    of its models, then those that have one more than it names: what it was right or wrong to do
    without. Models that do not exist are left out; `absent` names them.

    Args:
        models_of_scene: the models that the scene names, `static` among them.
        existing: all models there are, in the order in which they are applied.
        offered: models that the array and its calibration could do as well.
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
    """Models that a scene names but that do not exist."""
    return tuple(name for name in models_of_scene if name not in existing)

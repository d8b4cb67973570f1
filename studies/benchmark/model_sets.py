"""Model sets that are compared: built up one model at a time, and the full set without each one.

The first show the gain of each model for its run time, the second show its effect in the full set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from service.estimation.pipeline.model_set import MODEL_NAMES

BASE_MODELS = ("unwrap", "static")
"""First model set: the models that every force needs."""
MODELS_BY_IMPORTANCE = ("denoise", "skew", "gas", "rubber", "hysteresis", "temperature", "ambient")


@dataclass(frozen=True)
class ComparedModelSet:
    """Model set, and its relation to the others.

    Attributes:
        label: short name for tables and plots.
        models: the models, in the order of `MODEL_NAMES`.
        is_built_up: True for the first set and each set with one model more than the set before.
        added_model: model that it adds to the set before; None for the first and ablated sets.
        missing_model: the one model of the full set that is missing in it; None otherwise.
        extra_model: model that it adds to the full set.
        is_full_set: True for the scene's full set.
    """

    label: str
    models: tuple[str, ...]
    is_built_up: bool
    added_model: str | None
    missing_model: str | None
    is_full_set: bool
    extra_model: str | None = None


def list_model_sets(
    scene_models: Sequence[str],
    all_models: Sequence[str] = MODEL_NAMES,
    extra_models: Sequence[str] = (),
) -> tuple[ComparedModelSet, ...]:
    """List the model sets to compare for a scene, without duplicates.

    First the built-up ones, ending with the scene's full set, then the full set without each of its
    models, then the full set with each further model. Unknown models are left out; see
    `list_missing_models`.

    Args:
        scene_models: models of the scene, with `static`.
        all_models: all models, in order of application.
        extra_models: further models that array and calibration support.
    """
    whole = tuple(name for name in all_models if name in scene_models)
    later = [name for name in all_models if name not in (*BASE_MODELS, *MODELS_BY_IMPORTANCE)]
    order = [name for name in (*MODELS_BY_IMPORTANCE, *later) if name in whole]
    less = {tuple(m for m in whole if m != name): name for name in whole if name != "static"}
    built: list[ComparedModelSet] = []
    chosen = [name for name in BASE_MODELS if name in whole]
    for added in (None, *order):
        chosen += [] if added is None else [added]
        models = tuple(name for name in all_models if name in chosen)
        label = "+".join(models) if added is None else f"+{added}"
        if models == whole:
            label = f"{label} (whole)" if added is None else f"whole ({label})"
        built.append(
            ComparedModelSet(label, models, True, added, less.get(models), models == whole)
        )
    seen = {model_set.models for model_set in built}
    ablated = [
        ComparedModelSet(f"whole -{name}", models, False, None, name, False)
        for models, name in less.items()
        if models not in seen
    ]
    more = [
        ComparedModelSet(
            f"whole +{name}",
            tuple(m for m in all_models if m in (*whole, name)),
            is_built_up=False,
            added_model=None,
            missing_model=None,
            is_full_set=False,
            extra_model=name,
        )
        for name in all_models
        if name in extra_models and name not in whole
    ]
    return (*built, *ablated, *more)


def list_missing_models(
    scene_models: Sequence[str], all_models: Sequence[str] = MODEL_NAMES
) -> tuple[str, ...]:
    """Return the models of a scene that do not exist."""
    return tuple(name for name in scene_models if name not in all_models)

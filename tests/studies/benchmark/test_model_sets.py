"""Which ladders are compared."""

from __future__ import annotations

from service.estimation.pipeline.params import MODEL_NAMES
from studies.benchmark.draws import list_missing_models, list_model_sets

LADDER = (
    *("unwrap", "temperature", "ambient", "gas", "static"),
    *("rubber", "skew", "denoise", "hysteresis"),
)


def test_with_two_models_there_is_the_whole_ladder_and_that_without_unwrapping() -> None:
    whole, less = list_model_sets(("unwrap", "static"), all_models=("unwrap", "static"))
    assert (whole.models, whole.is_full_set, whole.missing_model) == (
        ("unwrap", "static"),
        True,
        None,
    )
    assert (less.models, less.is_full_set, less.missing_model) == (("static",), False, "unwrap")


def test_a_scene_with_one_model_has_one_rung() -> None:
    (only,) = list_model_sets(("static",), all_models=LADDER)
    assert (only.models, only.is_full_set, only.is_built_up) == (("static",), True, True)


def test_rungs_are_built_up_by_what_matters_and_applied_in_the_order_of_the_models() -> None:
    built = [
        model_set
        for model_set in list_model_sets(LADDER, all_models=LADDER)
        if model_set.is_built_up
    ]
    assert [model_set.added_model for model_set in built] == [
        *(None, "denoise", "skew", "gas", "rubber", "hysteresis", "temperature", "ambient"),
    ]
    assert built[3].models == ("unwrap", "gas", "static", "skew", "denoise")
    assert [model_set.is_full_set for model_set in built] == [False] * 7 + [True]
    assert built[-1].models == LADDER


def test_every_model_but_static_is_left_out_of_the_whole_once() -> None:
    less = {
        model_set.missing_model: model_set.models
        for model_set in list_model_sets(LADDER, all_models=LADDER)
        if model_set.missing_model
    }
    assert set(less) == set(LADDER) - {"static"}
    for name, models in less.items():
        assert models == tuple(model for model in LADDER if model != name)


def test_no_ladder_comes_twice_and_every_label_is_its_own() -> None:
    for scene in (LADDER, LADDER[3:], ("static", "denoise"), ("unwrap", "gas", "static")):
        made = list_model_sets(scene, all_models=LADDER)
        assert len({model_set.models for model_set in made}) == len(made)
        assert len({model_set.label for model_set in made}) == len(made)
        assert sum(model_set.is_full_set for model_set in made) == 1


def test_the_rung_before_the_last_is_also_the_whole_without_the_last() -> None:
    before = list_model_sets(("unwrap", "static", "gas", "denoise"), all_models=LADDER)[1]
    assert (before.added_model, before.missing_model, before.is_built_up) == (
        "denoise",
        "gas",
        True,
    )


def test_the_first_rung_is_built_up_even_if_it_lacks_but_one_model() -> None:
    first, whole, less = list_model_sets(("unwrap", "static", "denoise"), all_models=LADDER)
    assert (first.models, first.is_built_up, first.missing_model) == (
        ("unwrap", "static"),
        True,
        "denoise",
    )
    assert (whole.is_full_set, whole.added_model) == (True, "denoise")
    assert (less.missing_model, less.is_built_up) == ("unwrap", False)


def test_models_that_there_are_not_are_left_out_and_named() -> None:
    existing = ("unwrap", "gas", "static")
    (default,) = (
        model_set
        for model_set in list_model_sets(LADDER, all_models=existing)
        if model_set.is_full_set
    )
    assert default.models == existing
    assert list_missing_models(LADDER, all_models=existing) == tuple(
        m for m in LADDER if m not in existing
    )


def test_a_model_that_nobody_thought_of_comes_last() -> None:
    made = list_model_sets(("unwrap", "static", "magic", "gas"), all_models=("magic", *LADDER))
    assert [model_set.added_model for model_set in made if model_set.is_built_up] == [
        None,
        "gas",
        "magic",
    ]


def test_the_ladder_of_today_is_compared() -> None:
    assert list_model_sets(MODEL_NAMES)[0].models == ("unwrap", "static")


def test_models_that_a_scene_does_without_are_tried_on_top_of_its_whole() -> None:
    made = list_model_sets(
        ("unwrap", "static", "denoise"), all_models=LADDER, extra_models=("gas", "denoise")
    )
    more = [model_set for model_set in made if model_set.extra_model]
    assert [(model_set.label, model_set.models) for model_set in more] == [
        ("whole +gas", ("unwrap", "gas", "static", "denoise"))
    ]
    assert not any(model_set.is_full_set or model_set.is_built_up for model_set in more)

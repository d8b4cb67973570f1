"""What becomes wrong with an array is said once, and once that it is over."""

from __future__ import annotations

import pytest

from service.node.acquisition_process import WarningDebouncer

SILENT = {"T02": "tile T02 does not answer"}


T02 = "tile T02 does not answer"
WORSE = {"T02": "another part answers in place of tile T02"}
BOTH = {**SILENT, "": "the bus is stuck or cut"}


@pytest.mark.parametrize(
    "told",
    [
        pytest.param([({}, ()), (SILENT, ()), (SILENT, (T02,)), (SILENT, ())], id="said once"),
        pytest.param([(SILENT, ()), ({}, ())] * 5, id="not said if it comes and goes"),
        pytest.param(
            [
                *[(SILENT, ()), (SILENT, (T02,)), ({}, ())],
                (SILENT, ()),  # a moment of sense is no recovery
                *[({}, ()), ({}, (f"no longer: {T02}",)), ({}, ())],
            ],
            id="its end is said once and only if it lasts",
        ),
        pytest.param(
            [(SILENT, ()), (SILENT, (T02,)), (WORSE, ()), (WORSE, (WORSE["T02"],))],
            id="another one is said again",
        ),
        pytest.param(
            [
                *[(BOTH, ()), (BOTH, tuple(BOTH.values()))],
                *[(SILENT, ()), (SILENT, ("no longer: the bus is stuck or cut",))],
            ],
            id="each by itself",
        ),
    ],
)
def test_a_lasting_warning_and_its_end_are_said_once(
    told: list[tuple[dict[str, str], tuple[str, ...]]],
) -> None:
    notices = WarningDebouncer()
    for warnings, said in told:
        assert sorted(notices.update(warnings)) == sorted(said)

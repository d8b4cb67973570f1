"""`foottile compare` over many sessions: a row of a manifest for each, with what differs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from devices.errors import UsageError
from service.cli.many import run_plan, spread_over
from service.cli.options import pair
from service.cli.reference_options import named_values, sole_size, text_stated

if TYPE_CHECKING:
    from service.offline.archive.job_runner import OutcomeCounts
    from service.offline.archive.jobs import Job
    from service.offline.archive.tasks import CompareTask
    from service.offline.comparison import CompareOptions

MISSED = "limit missed"
"""The verdict on a session of which a limit was missed."""
_NUMBERS = ("rate_hz", "contact_n", "reference_sigma_n", "reference_cop_sigma_m")
_TEXTS = ("map", "units", "sign", "sole_m", "lag_range_s", "cop_offset_m")
_OF_TEXT = ("skip_rows", "units_row", "decimal", "encoding")
_NAME = re.compile(r"[\w-][\w.-]*")
Said = Mapping[str, str | float | None]


def options_of(said: Said, *, remove_offset: bool) -> CompareOptions:
    """What options, or the cells of a row, say of a comparison.

    Raises:
        UsageError: one of them cannot be meant.
    """
    from service.offline.comparison import CompareOptions
    from storage.formats.reference import ReferenceOptions

    def text(name: str) -> str | None:
        value = said.get(name)
        return None if value is None else str(value)

    return CompareOptions(
        stated=ReferenceOptions(
            named_values(text("map"), "--map"),
            named_values(text("units"), "--units"),
            text("sign"),
            _number(said, "rate_hz"),
            text_stated(said),
            sole_size(text("sole_m")),
        ),
        lag_range_s=pair(text("lag_range_s"), "--lag-range-s"),
        remove_offset=remove_offset,
        cop_offset_m=pair(text("cop_offset_m"), "--cop-offset-m") or (0.0, 0.0),
        **{name: _number(said, name) for name in _NUMBERS if name != "rate_hz"},
    )


def compare_many(
    manifest: Path,
    said: Said,
    limits: Mapping[str, float],
    *,
    remove_offset: bool,
    out: str,
    jobs: int | None,
    scheduler: str | None,
    as_json: bool,
) -> OutcomeCounts:
    """Compare the sessions of a manifest, each with the reference of its row.

    Args:
        manifest: with columns `session` and `reference`; others win over `said` where they are
            not empty.
        said: by the command's options.
        limits: of figures.
        remove_offset: of all.
        out: of the results, as a path or URI.
        jobs: processes.
        scheduler: of a cluster.
        as_json: each outcome is a line of JSON on stdout.

    Raises:
        UsageError: as for `run_many`, or an option cannot be meant.
    """
    from service.offline.archive.locations import make_absolute
    from service.offline.archive.manifest import read_rows

    options_of(said, remove_offset=remove_offset)  # what is wrong in all rows is wrong usage
    known = {"session", "reference", "name", *_TEXTS, *_OF_TEXT, *_NUMBERS}
    out = make_absolute(out)

    def rows() -> Iterator[dict[str, str]]:
        return read_rows(manifest, known)

    return run_plan(
        (_job(manifest, row, said, limits, remove_offset, out) for row in rows()),
        command="compare",
        count=rows,
        out=out,
        spread=spread_over(jobs, scheduler),
        as_json=as_json,
    )


def _job(
    manifest: Path,
    row: Mapping[str, str],
    said: Said,
    limits: Mapping[str, float],
    remove_offset: bool,
    out: str,
) -> Job:
    """Of a row; one that cannot be meant is a job that fails."""
    from service.offline.archive.jobs import Job
    from service.offline.archive.locations import parse_session_location
    from service.offline.archive.tasks import InvalidTask

    place = parse_session_location(row["session"])
    try:
        name = _name(row, place.session_id)
        task = _task(manifest, row, said, limits, remove_offset=remove_offset)
    except UsageError as error:
        return Job(place, InvalidTask(str(error), "compare"), out)
    return Job(replace(place, session_id=name), task, out)


def _name(row: Mapping[str, str], default: str) -> str:
    name = row.get("name") or default
    if not _NAME.fullmatch(name):
        raise UsageError(f"name {name!r}", expected="letters, digits, - and _")
    return name


def _task(
    manifest: Path,
    row: Mapping[str, str],
    said: Said,
    limits: Mapping[str, float],
    *,
    remove_offset: bool,
) -> CompareTask:
    from service.offline.archive.manifest import resolve_path
    from service.offline.archive.tasks import CompareTask

    if not row.get("reference"):
        raise UsageError("there is no reference in its row")
    given = {**said, **{name: value for name, value in row.items() if value}}
    options = options_of(given, remove_offset=remove_offset)
    return CompareTask(resolve_path(manifest, row["reference"]), options, dict(limits))


def _number(said: Said, name: str) -> float | None:
    value = said.get(name)
    try:
        number = None if value is None else float(value)
    except ValueError:
        number = -1.0
    if number is not None and not 0.0 <= number < float("inf"):
        raise UsageError(f"{name} {value!r}", expected="a number, zero or more")
    return number

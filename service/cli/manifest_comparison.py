"""`foottile compare` over many sessions, with a manifest row for each."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from devices.errors import UsageError
from service.cli.multi_session import make_job_mapper, run_jobs_with_report
from service.cli.options import parse_pair
from service.cli.reference_options import make_reference_options

if TYPE_CHECKING:
    from service.offline.archive.job_runner import OutcomeCounts
    from service.offline.archive.jobs import Job
    from service.offline.archive.tasks import CompareTask
    from service.offline.comparison import CompareOptions

LIMIT_MISSED = "limit missed"
"""Verdict on a session that misses a limit."""
_NUMBER_COLUMNS = ("rate_hz", "contact_n", "reference_sigma_n", "reference_cop_sigma_m")
_TEXT_COLUMNS = ("map", "units", "sign", "sole_m", "lag_range_s", "cop_offset_m")
_TEXT_LAYOUT_COLUMNS = ("skip_rows", "units_row", "decimal", "encoding")
_NAME = re.compile(r"[\w-][\w.-]*")
StatedOptions = Mapping[str, str | float | None]


def make_compare_options(stated: StatedOptions, *, remove_offset: bool) -> CompareOptions:
    """Return comparison options from command options or manifest cells.

    Raises:
        UsageError: an invalid value.
    """
    from service.offline.comparison import CompareOptions

    def text(name: str) -> str | None:
        value = stated.get(name)
        return None if value is None else str(value)

    return CompareOptions(
        stated=make_reference_options(stated, _parse_number(stated, "rate_hz")),
        lag_range_s=parse_pair(text("lag_range_s"), "--lag-range-s"),
        remove_offset=remove_offset,
        cop_offset_m=parse_pair(text("cop_offset_m"), "--cop-offset-m") or (0.0, 0.0),
        **{name: _parse_number(stated, name) for name in _NUMBER_COLUMNS if name != "rate_hz"},
    )


def compare_manifest(
    manifest: Path,
    stated: StatedOptions,
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
        manifest: CSV with columns `session` and `reference`; further non-empty cells override
            `stated`.
        stated: options of the command.
        limits: limits by figure.
        remove_offset: option for all sessions.
        out: path or URI of the results.
        jobs: number of processes.
        scheduler: address of a Dask scheduler.
        as_json: print each outcome as a line of JSON on stdout.

    Raises:
        UsageError: as for `run_task`, or an invalid option.
    """
    from service.offline.archive.locations import make_absolute
    from service.offline.archive.manifest import read_rows

    make_compare_options(
        stated, remove_offset=remove_offset
    )  # an option that is wrong for all rows
    columns = {
        "session",
        "reference",
        "name",
        *_TEXT_COLUMNS,
        *_TEXT_LAYOUT_COLUMNS,
        *_NUMBER_COLUMNS,
    }
    out = make_absolute(out)

    def list_rows() -> Iterator[dict[str, str]]:
        return read_rows(manifest, columns)

    return run_jobs_with_report(
        (_make_job(manifest, row, stated, limits, remove_offset, out) for row in list_rows()),
        command="compare",
        list_again=list_rows,
        out=out,
        job_mapper=make_job_mapper(jobs, scheduler),
        as_json=as_json,
    )


def _make_job(
    manifest: Path,
    row: Mapping[str, str],
    stated: StatedOptions,
    limits: Mapping[str, float],
    remove_offset: bool,
    out: str,
) -> Job:
    """Return the job of a row; an invalid row gives a job that fails."""
    from service.offline.archive.jobs import Job
    from service.offline.archive.locations import parse_session_location
    from service.offline.archive.tasks import InvalidTask

    place = parse_session_location(row["session"])
    try:
        name = _choose_name(row, place.session_id)
        task = _make_task(manifest, row, stated, limits, remove_offset=remove_offset)
    except UsageError as error:
        return Job(place, InvalidTask(str(error), "compare"), out)
    return Job(replace(place, session_id=name), task, out)


def _choose_name(row: Mapping[str, str], default: str) -> str:
    name = row.get("name") or default
    if not _NAME.fullmatch(name):
        raise UsageError(f"name {name!r}", expected="letters, digits, - and _")
    return name


def _make_task(
    manifest: Path,
    row: Mapping[str, str],
    stated: StatedOptions,
    limits: Mapping[str, float],
    *,
    remove_offset: bool,
) -> CompareTask:
    from service.offline.archive.manifest import resolve_path
    from service.offline.archive.tasks import CompareTask

    if not row.get("reference"):
        raise UsageError("the row names no reference")
    values = {**stated, **{name: value for name, value in row.items() if value}}
    options = make_compare_options(values, remove_offset=remove_offset)
    return CompareTask(resolve_path(manifest, row["reference"]), options, dict(limits))


def _parse_number(stated: StatedOptions, name: str) -> float | None:
    value = stated.get(name)
    try:
        number = None if value is None else float(value)
    except ValueError:
        number = -1.0
    if number is not None and not 0.0 <= number < float("inf"):
        raise UsageError(f"{name} {value!r}", expected="a number, zero or more")
    return number

"""`foottile compare`: comparison of a session with a reference."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import UsageError, require_extra
from service.cli.commands.sessions import find_sealed_file
from service.cli.multi_session import BatchOptions, run_jobs_with_report
from service.cli.options import (
    EXIT_INCOMPLETE,
    DataOption,
    JsonOption,
    add_options,
    echo,
    echo_lines,
    exit_incomplete_for,
    open_result_folder,
    parse_pair,
    print_json,
    show_progress,
)
from service.cli.reference_options import (
    LagRangeOption,
    SoleSizeOption,
    TableOptions,
    make_reference_options,
    parse_named_values,
)

if TYPE_CHECKING:
    from service.offline.archive.jobs import OutcomeCounts
    from service.offline.comparison import CompareOptions

LIMIT_MISSED = "limit missed"
"""Verdict on a session that misses a limit."""
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
        contact_n=_parse_number(stated, "contact_n"),
        reference_sigma_n=_parse_number(stated, "reference_sigma_n"),
        reference_cop_sigma_m=_parse_number(stated, "reference_cop_sigma_m"),
    )


def compare_manifest(
    manifest: Path,
    batch: BatchOptions,
    stated: StatedOptions,
    limits: Mapping[str, float],
    *,
    remove_offset: bool,
    out: str,
    as_json: bool,
) -> OutcomeCounts:
    """Compare the sessions of a manifest, each with the reference of its row.

    Args:
        manifest: CSV with columns `session` and `reference`; further non-empty cells override
            `stated`.
        batch: processes or cluster.
        stated: options of the command.
        limits: limits by figure.
        remove_offset: option for all sessions.
        out: path or URI of the results.
        as_json: print each outcome as a line of JSON on stdout.

    Raises:
        UsageError: as for `run_task`, or an invalid option.
    """
    from service.offline.archive.jobs import Job
    from service.offline.archive.locations import make_absolute, parse_session_location
    from service.offline.archive.manifest import read_rows, resolve_path
    from service.offline.archive.tasks import CompareTask, InvalidTask

    # An option that is wrong is so for all rows.
    make_compare_options(stated, remove_offset=remove_offset)
    columns = {"session", "reference", "name", *stated}
    out = make_absolute(out)

    def list_rows() -> Iterator[dict[str, str]]:
        return read_rows(manifest, columns)

    def make_job(row: Mapping[str, str]) -> Job:
        """Return the job of a row; an invalid row gives a job that fails."""
        place = parse_session_location(row["session"])
        if not row.get("reference"):
            return Job(place, InvalidTask("the row names no reference", "compare"), out)
        try:
            name = _choose_name(row, place.session_id)
            values = {**stated, **{name: value for name, value in row.items() if value}}
            options = make_compare_options(values, remove_offset=remove_offset)
            task = CompareTask(resolve_path(manifest, row["reference"]), options, dict(limits))
        except UsageError as error:
            return Job(place, InvalidTask(str(error), "compare"), out)
        return Job(replace(place, session_id=name), task, out)

    return run_jobs_with_report(
        map(make_job, list_rows()),
        command="compare",
        list_again=list_rows,
        out=out,
        job_mapper=batch.make_job_mapper(),
        as_json=as_json,
    )


def _choose_name(row: Mapping[str, str], default: str) -> str:
    name = row.get("name") or default
    if not _NAME.fullmatch(name):
        raise UsageError(f"name {name!r}", expected="letters, digits, - and _")
    return name


def _parse_number(stated: StatedOptions, name: str) -> float | None:
    value = stated.get(name)
    try:
        number = None if value is None else float(value)
    except ValueError:
        number = -1.0
    if number is not None and not 0.0 <= number < float("inf"):
        raise UsageError(f"{name} {value!r}", expected="a number, zero or more")
    return number


@require_extra("server", "`foottile compare`")
@add_options
def compare_command(
    session: Annotated[
        str | None, typer.Argument(help="A sealed file, a session's folder, or an id in --data.")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Reference: .c3d, .csv, .txt, .parquet (or a session), .mot, .sto, .asf, .bag, "
            ".mcap, .db3 or a bag's folder, or .npz of a pressure plate."
        ),
    ] = None,
    out: Annotated[
        str | None,
        typer.Option(
            help="Folder for compare.json, compare.md, compare.png and series.parquet; default: "
            "with the session, in comparisons/ and the reference's name. Each of many sessions has "
            "a folder in it."
        ),
    ] = None,
    *,
    table: TableOptions,
    sole_m: SoleSizeOption = None,
    reference_sigma_n: Annotated[
        float | None,
        typer.Option(min=0.0, help="Reference force uncertainty (1 sigma, N), for coverage."),
    ] = None,
    reference_cop_sigma_m: Annotated[
        float | None,
        typer.Option(min=0.0, help="Reference COP uncertainty (1 sigma, m)."),
    ] = None,
    remove_offset: Annotated[
        bool, typer.Option("--remove-offset", help="Subtract the reference's mean in flight.")
    ] = False,
    lag_range_s: LagRangeOption = None,
    contact_n: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Contact threshold of the reference; default: 5 sigma of its noise."
        ),
    ] = None,
    cop_offset_m: Annotated[
        str | None,
        typer.Option(metavar="X,Y", help="Offset added to the reference's COP."),
    ] = None,
    limits: Annotated[
        str | None,
        typer.Option(
            metavar="FIGURE=LIMIT,...",
            help="Limits of mean figures: grf_mae_n=1,cop_p95_m=0.004; a missed one is exit code "
            "3. They are lower limits for coverage, R² and counts, upper limits else.",
        ),
    ] = None,
    data: DataOption = None,
    batch: BatchOptions,
    as_json: JsonOption = False,
) -> None:
    """Compare a session with a reference: a force plate, an insole, another session.

    Clocks are aligned first. Lag, drift, offset and scale have intervals; only lag and drift are
    applied by default. Without --out the results are stored with the session. --manifest names many
    sessions, with columns session and reference; options that differ by row are further columns:
    map, units, sign, name of the result and so on.

    Exit codes: 0 success, 1 failure, 2 wrong usage, 3 written, but a limit is missed, or some of
    many sessions failed.
    """
    from service.offline.comparison import write_comparison
    from service.offline.figure_output import create_figure

    parsed_limits = {
        name: _parse_limit(name, text)
        for name, text in parse_named_values(limits, "--limits").items()
    }
    stated: dict[str, str | float | None] = {
        **vars(table),
        "sole_m": sole_m,
        "lag_range_s": lag_range_s,
        "contact_n": contact_n,
        "cop_offset_m": cop_offset_m,
        "reference_sigma_n": reference_sigma_n,
        "reference_cop_sigma_m": reference_cop_sigma_m,
    }
    create_figure(1.0, 1.0)  # reports a missing package early
    manifest = batch.manifest
    if manifest is not None or session is None or reference is None:
        if manifest is None or session is not None or reference is not None or out is None:
            raise UsageError(
                "session and reference are not named, or twice",
                expected="SESSION and --reference; or for many --manifest and --out",
            )
        summary = compare_manifest(
            manifest,
            batch,
            stated,
            parsed_limits,
            remove_offset=remove_offset,
            out=out,
            as_json=as_json,
        )
        if summary.states["failed"] or summary.verdicts[LIMIT_MISSED]:
            raise typer.Exit(EXIT_INCOMPLETE)
        return
    options = make_compare_options(stated, remove_offset=remove_offset)
    source = find_sealed_file(session, data)
    title = f"{Path(session).name} against {reference.name}"
    with (
        open_result_folder(
            Path(out) if out is not None else get_comparison_folder(source, reference)
        ) as folder,
        show_progress(f"comparing {title}"),
    ):
        done = write_comparison(source, reference, options, parsed_limits, folder, title)
    if as_json:
        print_json(done.content)
    else:
        echo_lines(done.report_text)
        echo(f"{folder}: compare.json, compare.md, compare.png, series.parquet")
    exit_incomplete_for([f"limit missed: {line}" for line in done.missed_limits])


def get_comparison_folder(source: Path, reference: Path) -> Path:
    """Return the folder of a comparison within its session.

    Raises:
        UsageError: the session is a single file.
    """
    from storage.sessions.comparisons import COMPARISONS_FOLDER
    from storage.sessions.metadata import SESSION_NAME

    if not (source.parent / SESSION_NAME).is_file():
        raise UsageError(
            f"{source.name} is a single file, without a folder for results",
            remedy="Add --out FOLDER, or name a session's folder or id",
        )
    return source.parent / COMPARISONS_FOLDER / reference.stem


def _parse_limit(name: str, text: str) -> float:
    from service.offline.compare.report import FIGURE_TITLES

    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if name not in FIGURE_TITLES or not limit >= 0.0:
        raise UsageError(
            f"--limits {name}={text}", expected=f"a limit of {', '.join(FIGURE_TITLES)}"
        )
    return limit

"""`foottile compare`: a session against a force plate, an insole, or another session."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import typer

from devices.errors import UsageError, require_extra
from service.cli.commands.sessions import sealed_file
from service.cli.compare_many import MISSED, compare_many, options_of
from service.cli.many import NOT_ALL, JobsOption, ManifestOption, SchedulerOption
from service.cli.options import JsonOption, print_json, progress, remark, say, say_lines
from service.cli.reference_options import (
    ColumnsOfReference,
    Decimal,
    Encoding,
    LagRange,
    RateOfReference,
    SignOfReference,
    SkipRows,
    SoleOfReference,
    UnitsOfReference,
    UnitsRow,
    named_values,
)
from service.cli.result_folder import result_folder


@require_extra("server", "`foottile compare`")
def compare_command(
    session: Annotated[
        str | None, typer.Argument(help="A sealed file, a session's folder, or an id in --data.")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="What to compare with: .c3d, .csv, .txt, .parquet (or a session), .mot, .sto, "
            ".asf, .bag, .mcap, .db3 or a bag's folder, or .npz of a pressure plate."
        ),
    ] = None,
    out: Annotated[
        str | None,
        typer.Option(
            help="Folder for compare.json, compare.md, compare.png and series.parquet; default: "
            "with the session, in comparisons/ and the reference's name. Of many sessions each has "
            "a folder in it."
        ),
    ] = None,
    columns: ColumnsOfReference = None,
    units: UnitsOfReference = None,
    sign: SignOfReference = None,
    rate_hz: RateOfReference = None,
    skip_rows: SkipRows = None,
    units_row: UnitsRow = None,
    decimal: Decimal = None,
    encoding: Encoding = None,
    sole_m: SoleOfReference = None,
    reference_sigma_n: Annotated[
        float | None,
        typer.Option(min=0.0, help="Standard uncertainty of the reference; tells coverage."),
    ] = None,
    reference_cop_sigma_m: Annotated[
        float | None,
        typer.Option(min=0.0, help="The same of each coordinate of its centre of pressure."),
    ] = None,
    remove_offset: Annotated[
        bool, typer.Option("--remove-offset", help="Take off what the reference reads in flight.")
    ] = False,
    lag_range_s: LagRange = None,
    contact_n: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="From when on the reference bears load; default: 5 sigma of its noise."
        ),
    ] = None,
    cop_offset_m: Annotated[
        str | None,
        typer.Option(metavar="X,Y", help="Added to the reference's centre of pressure."),
    ] = None,
    limits: Annotated[
        str | None,
        typer.Option(
            metavar="FIGURE=LIMIT,...",
            help="Exit code 3 if the mean of a figure is more, as grf_mae_n=1,cop_p95_m=0.004; of "
            "coverage, R² and counts, if it is less.",
        ),
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Data folder of the server; default: the user's.")
    ] = None,
    manifest: ManifestOption = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare a session with a reference: a force plate, an insole, another session.

    Clocks are aligned first: lag and drift, offset and scale come with intervals, and none of them
    but lag and drift is applied unless asked for. Without --out all is kept with the session, in
    its folder. Many sessions are named by --manifest, with columns session and reference; what
    differs by row is a column, too: map, units, sign, name of the result and the like.

    Exit codes: 0 good, 1 failed, 2 wrong usage, 3 written, but a limit is missed, or some of many
    sessions failed.
    """
    from service.offline.compare.report import FIGURE_TITLES
    from service.offline.comparison_output import write_comparison
    from service.offline.figure_output import create_figure

    asked = {
        name: _limit(name, text, FIGURE_TITLES)
        for name, text in named_values(limits, "--limits").items()
    }
    said: dict[str, str | float | None] = {
        "map": columns,
        "units": units,
        "sign": sign,
        "rate_hz": rate_hz,
        "skip_rows": skip_rows,
        "units_row": units_row,
        "decimal": decimal,
        "encoding": encoding,
        "sole_m": sole_m,
        "lag_range_s": lag_range_s,
        "contact_n": contact_n,
        "cop_offset_m": cop_offset_m,
        "reference_sigma_n": reference_sigma_n,
        "reference_cop_sigma_m": reference_cop_sigma_m,
    }
    create_figure(1.0, 1.0)  # says what is missing before anything takes time
    if manifest is not None or session is None or reference is None:
        if manifest is None or session is not None or reference is not None or out is None:
            raise UsageError(
                "which session is compared with what is not said, or twice",
                expected="SESSION and --reference; or for many --manifest and --out",
            )
        summary = compare_many(
            manifest,
            said,
            asked,
            remove_offset=remove_offset,
            out=out,
            jobs=jobs,
            scheduler=scheduler,
            as_json=as_json,
        )
        if summary.states["failed"] or summary.verdicts[MISSED]:
            raise typer.Exit(NOT_ALL)
        return
    options = options_of(said, remove_offset=remove_offset)
    source = sealed_file(session, data)
    title = f"{Path(session).name} against {reference.name}"
    with (
        result_folder(Path(out) if out is not None else kept_with(source, reference)) as folder,
        progress(f"comparing {title}"),
    ):
        done = write_comparison(source, reference, options, asked, folder, title)
    if as_json:
        print_json(done.content)
    else:
        say_lines(done.report_text)
        say(f"{folder}: compare.json, compare.md, compare.png, series.parquet")
    for line in done.missed_limits:
        remark(f"limit missed: {line}")
    if done.missed_limits:
        raise typer.Exit(3)


def kept_with(source: Path, reference: Path) -> Path:
    """Where a comparison lies with its session.

    Raises:
        UsageError: the session is a file by itself.
    """
    from storage.sessions.comparisons import COMPARISONS_FOLDER
    from storage.sessions.metadata import SESSION_NAME

    if not (source.parent / SESSION_NAME).is_file():
        raise UsageError(
            f"{source.name} is a file by itself, with which nothing is kept",
            remedy="Add --out FOLDER, or name a session's folder or id",
        )
    return source.parent / COMPARISONS_FOLDER / reference.stem


def _limit(name: str, text: str, known: Collection[str]) -> float:
    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if name not in known or not limit >= 0.0:
        raise UsageError(f"--limits {name}={text}", expected=f"a limit of {', '.join(known)}")
    return limit

"""`foottile compare`: comparison of a session with a reference."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import typer

from devices.errors import UsageError, require_extra
from service.cli.commands.sessions import find_sealed_file
from service.cli.manifest_comparison import LIMIT_MISSED, compare_manifest, make_compare_options
from service.cli.multi_session import EXIT_INCOMPLETE, JobsOption, ManifestOption, SchedulerOption
from service.cli.options import JsonOption, echo, echo_lines, print_json, remark, show_progress
from service.cli.reference_options import (
    DecimalOption,
    EncodingOption,
    LagRangeOption,
    ReferenceColumnsOption,
    ReferenceRateOption,
    ReferenceSignOption,
    ReferenceUnitsOption,
    SkipRowsOption,
    SoleSizeOption,
    UnitsRowOption,
    parse_named_values,
)
from service.cli.result_folder import open_result_folder


@require_extra("server", "`foottile compare`")
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
    columns: ReferenceColumnsOption = None,
    units: ReferenceUnitsOption = None,
    sign: ReferenceSignOption = None,
    rate_hz: ReferenceRateOption = None,
    skip_rows: SkipRowsOption = None,
    units_row: UnitsRowOption = None,
    decimal: DecimalOption = None,
    encoding: EncodingOption = None,
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
    data: Annotated[
        Path | None, typer.Option(help="Data folder of the server; default: the user's.")
    ] = None,
    manifest: ManifestOption = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
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
    from service.offline.compare.report import FIGURE_TITLES
    from service.offline.comparison_output import write_comparison
    from service.offline.figure_output import create_figure

    parsed_limits = {
        name: _parse_limit(name, text, FIGURE_TITLES)
        for name, text in parse_named_values(limits, "--limits").items()
    }
    stated: dict[str, str | float | None] = {
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
    create_figure(1.0, 1.0)  # reports a missing package early
    if manifest is not None or session is None or reference is None:
        if manifest is None or session is not None or reference is not None or out is None:
            raise UsageError(
                "session and reference are not named, or twice",
                expected="SESSION and --reference; or for many --manifest and --out",
            )
        summary = compare_manifest(
            manifest,
            stated,
            parsed_limits,
            remove_offset=remove_offset,
            out=out,
            jobs=jobs,
            scheduler=scheduler,
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
    for line in done.missed_limits:
        remark(f"limit missed: {line}")
    if done.missed_limits:
        raise typer.Exit(3)


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


def _parse_limit(name: str, text: str, figures: Collection[str]) -> float:
    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if name not in figures or not limit >= 0.0:
        raise UsageError(f"--limits {name}={text}", expected=f"a limit of {', '.join(figures)}")
    return limit

"""`foottile compare`: a session against a force plate, an insole, or another session."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import typer

from devices.errors import UsageError, needs_extra
from service.cli.commands.sessions import sealed_file
from service.cli.options import JsonOption, json_text, pair, print_json, progress, remark, say
from service.cli.result_folder import result_folder


@needs_extra("server", "`foottile compare`")
def compare_command(
    session: Annotated[
        str, typer.Argument(help="A sealed file, a session's folder, or an id in --data.")
    ],
    reference: Annotated[
        Path,
        typer.Option(
            help="What to compare with: .c3d, .csv, .parquet (or a session), .mot, .sto, or .npz "
            "of a pressure plate."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for compare.json, compare.md and compare.png.")],
    columns: Annotated[
        str | None,
        typer.Option(
            "--map",
            metavar="NAME=COLUMN,...",
            help="Which columns are time_s, grf_n, cop_x_m, cop_y_m; - before a column turns it.",
        ),
    ] = None,
    units: Annotated[
        str | None,
        typer.Option(
            metavar="NAME=UNIT,...",
            help="Of grf (N, kN, mN), cop (m, cm, mm) and time (s, ms, us, ns), unless columns "
            "have our names.",
        ),
    ] = None,
    sign: Annotated[
        str | None, typer.Option(help="Of the reference's force under load: + or -.")
    ] = None,
    reference_sigma_n: Annotated[
        float | None,
        typer.Option(min=0.0, help="Standard uncertainty of the reference; tells coverage."),
    ] = None,
    remove_offset: Annotated[
        bool, typer.Option("--remove-offset", help="Take off what the reference reads in flight.")
    ] = False,
    lag_range_s: Annotated[
        str | None,
        typer.Option(metavar="A,B", help="Least and greatest lag, where several would fit."),
    ] = None,
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
            help="Exit code 3 if the mean of a figure is beyond, as grf_mae_n=1,cop_p95_m=0.004.",
        ),
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Data folder of the server; default: the user's.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare a session with a reference: a force plate, an insole, another session.

    Clocks are aligned first: lag and drift, offset and scale come with intervals, and none of them
    but lag and drift is applied unless asked for. Exit codes: 0 good, 1 failed, 2 wrong usage, 3
    written, but a limit is missed.
    """
    from service.offline.compare.plot import plot_comparison
    from service.offline.compare.report import FIGURES, markdown
    from service.offline.comparison import CompareOptions, compare_session
    from service.offline.plots import new_figure
    from storage.durable import write_whole
    from storage.formats.reference import Stated

    asked = {name: _limit(name, text, FIGURES) for name, text in _pairs(limits, "--limits").items()}
    options = CompareOptions(
        stated=Stated(_pairs(columns, "--map"), _pairs(units, "--units"), sign),
        lag_range_s=pair(lag_range_s, "--lag-range-s"),
        remove_offset=remove_offset,
        contact_n=contact_n,
        cop_offset_m=pair(cop_offset_m, "--cop-offset-m") or (0.0, 0.0),
        reference_sigma_n=reference_sigma_n,
    )
    new_figure(1.0, 1.0)  # says what is missing before anything takes time
    source = sealed_file(session, data)
    title = f"{Path(session).name} against {reference.name}"
    with result_folder(out) as folder, progress(f"comparing {title}"):
        found = compare_session(source, reference, options)
        missed = [
            f"{name} is {found.errors.figures[name].mean:.4g}, and was to be within {limit:g}"
            for name, limit in asked.items()
            if not abs(found.errors.figures[name].mean) <= limit
        ]
        text = markdown(
            title, found.alignment, found.pairs, found.errors, found.trials_are, found.notes
        )
        png = plot_comparison(title, found.pairs, found.force_n, found.serials, found.errors)
        content = {**found.as_dict(), "limits": asked, "missed": missed}
        write_whole(folder / "compare.json", json_text(content).encode())
        write_whole(folder / "compare.md", text.encode())
        write_whole(folder / "compare.png", png)
    if as_json:
        print_json(content)
    else:
        say(text)
        say(f"{folder}: compare.json, compare.md, compare.png")
    for line in missed:
        remark(f"limit missed: {line}")
    if missed:
        raise typer.Exit(3)


def _pairs(text: str | None, option: str) -> dict[str, str]:
    """Names with what is said of them.

    Raises:
        UsageError: no name, nothing said, or a name twice.
    """
    found: dict[str, str] = {}
    for part in (text or "").split(","):
        name, equals, value = part.strip().partition("=")
        if not part.strip() and text is None:
            continue
        if not (name and equals and value) or name in found:
            raise UsageError(f"{option} {text!r}", expected="NAME=VALUE,..., each name once")
        found[name] = value
    return found


def _limit(name: str, text: str, known: Collection[str]) -> float:
    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if name not in known or not limit >= 0.0:
        raise UsageError(f"--limits {name}={text}", expected=f"a limit of {', '.join(known)}")
    return limit

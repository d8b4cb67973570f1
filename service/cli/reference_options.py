"""Options for facts that a reference's file lacks: columns, units, sign, rate, lag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import UsageError

if TYPE_CHECKING:
    from storage.formats.reference import ReferenceOptions

SOLE_MAX_M = 1.0

SoleSizeOption = Annotated[
    str | None,
    typer.Option(
        "--sole-m",
        metavar="LENGTH[,WIDTH]",
        help="Size of the insole, for a COP as a fraction of it.",
    ),
]
LagRangeOption = Annotated[
    str | None,
    typer.Option("--lag-range-s", metavar="A,B", help="Range of the lag, where several fit."),
]


@dataclass(frozen=True)
class TableOptions:
    """Options for the columns and the layout of a reference's file."""

    map: Annotated[
        str | None,
        typer.Option(
            metavar="NAME=COLUMN,...",
            help="Columns of time_s, grf_n, cop_x_m, cop_y_m; - before a column inverts its sign, "
            "+ adds two columns.",
        ),
    ] = None
    units: Annotated[
        str | None,
        typer.Option(
            metavar="NAME=UNIT,...",
            help="Units of grf (N, kN, mN), cop (m, cm, mm) and time (s, ms, us, ns), unless the "
            "file states them.",
        ),
    ] = None
    sign: Annotated[
        str | None,
        typer.Option(
            help="Sign of the reference's force under load: + or -; C3D force platforms state it."
        ),
    ] = None
    rate_hz: Annotated[
        float | None, typer.Option(help="Sample rate of a reference without times.")
    ] = None
    skip_rows: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Lines of a text table above its header, or above its numbers without a header.",
        ),
    ] = None
    units_row: Annotated[
        int | None, typer.Option(metavar="N", help="Line of the units, from 1.")
    ] = None
    decimal: Annotated[
        str | None, typer.Option(metavar=",|.", help="Decimal mark of a text table.")
    ] = None
    encoding: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Encoding of a text table: cp1252, cp932."),
    ] = None


def make_reference_options(stated: Mapping[str, object], rate_hz: float | None) -> ReferenceOptions:
    """Return how to read a reference, from options or cells by name.

    Raises:
        UsageError: an invalid value.
    """
    from storage.formats.readers.text import TextOptions
    from storage.formats.reference import ReferenceOptions

    text = {name: None if value is None else str(value) for name, value in stated.items()}
    return ReferenceOptions(
        parse_named_values(text.get("map"), "--map"),
        parse_named_values(text.get("units"), "--units"),
        text.get("sign"),
        rate_hz,
        TextOptions(
            _parse_int(text.get("skip_rows"), "--skip-rows"),
            _parse_int(text.get("units_row"), "--units-row"),
            text.get("decimal"),
            text.get("encoding"),
        ),
        _parse_sole_size(text.get("sole_m")),
    )


def _parse_int(text: str | None, option: str) -> int | None:
    try:
        return None if text is None else int(text)
    except ValueError:
        raise UsageError(f"{option} {text!r}", expected="a whole number") from None


def _parse_sole_size(text: str | None) -> tuple[float, ...]:
    """Return length, and width if stated, of an insole in m.

    Raises:
        UsageError: not a size of an insole.
    """
    if text is None:
        return ()
    try:
        size_m = tuple(float(part) for part in text.split(","))
    except ValueError:
        size_m = ()
    if len(size_m) not in (1, 2) or not all(0.0 < one < SOLE_MAX_M for one in size_m):
        raise UsageError(
            f"--sole-m {text!r} is not a size of an insole",
            expected=f"LENGTH or LENGTH,WIDTH, in metres, below {SOLE_MAX_M:g}",
        )
    return size_m


def parse_named_values(text: str | None, option: str) -> dict[str, str]:
    """Return values by name.

    Raises:
        UsageError: a missing name or value, or a repeated name.
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

"""How a user states what a reference's file does not say itself: columns, units, sign, lag."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import UsageError

if TYPE_CHECKING:
    from storage.formats.readers.text_options import TextOptions

SOLE_MAX_M = 1.0

ColumnsOfReference = Annotated[
    str | None,
    typer.Option(
        "--map",
        metavar="NAME=COLUMN,...",
        help="Which columns are time_s, grf_n, cop_x_m, cop_y_m; - before a column turns it, + "
        "between two adds them up.",
    ),
]
UnitsOfReference = Annotated[
    str | None,
    typer.Option(
        "--units",
        metavar="NAME=UNIT,...",
        help="Of grf (N, kN, mN), cop (m, cm, mm) and time (s, ms, us, ns), unless the file or "
        "our names state them.",
    ),
]
SignOfReference = Annotated[
    str | None,
    typer.Option(
        "--sign",
        help="Of the reference's force under load: + or -; force platforms of C3D show it.",
    ),
]
RateOfReference = Annotated[
    float | None,
    typer.Option(
        "--rate-hz", help="Samples a second, of a reference with sample numbers or without times."
    ),
]
SkipRows = Annotated[
    int | None,
    typer.Option(
        "--skip-rows",
        metavar="N",
        help="Lines above the line of names, of a table in text; above the numbers, without names.",
    ),
]
UnitsRow = Annotated[
    int | None,
    typer.Option("--units-row", metavar="N", help="Number of the line of units, from 1 on."),
]
Decimal = Annotated[
    str | None,
    typer.Option("--decimal", metavar=",|.", help="Mark of decimals of a table in text."),
]
Encoding = Annotated[
    str | None,
    typer.Option("--encoding", metavar="NAME", help="Of a table in text, as cp1252 or cp932."),
]
SoleOfReference = Annotated[
    str | None,
    typer.Option(
        "--sole-m",
        metavar="LENGTH[,WIDTH]",
        help="Size of the insole, where the reference's centre of pressure is a part of it.",
    ),
]
LagRange = Annotated[
    str | None,
    typer.Option(
        "--lag-range-s", metavar="A,B", help="Least and greatest lag, where several would fit."
    ),
]


def text_stated(said: Mapping[str, str | float | None]) -> TextOptions:
    """Return how a text is laid out, by options or cells of these names.

    Raises:
        UsageError: one of them cannot be meant.
    """
    from storage.formats.readers.text_options import TextOptions

    def text(name: str) -> str | None:
        value = said.get(name)
        return None if value is None else str(value)

    return TextOptions(
        _whole_number(text("skip_rows"), "--skip-rows"),
        _whole_number(text("units_row"), "--units-row"),
        text("decimal"),
        text("encoding"),
    )


def _whole_number(text: str | None, option: str) -> int | None:
    try:
        return None if text is None else int(text)
    except ValueError:
        raise UsageError(f"{option} {text!r}", expected="a whole number") from None


def sole_size(text: str | None) -> tuple[float, ...]:
    """Return length, and width if it is stated, of an insole in m.

    Raises:
        UsageError: they are no sizes of an insole.
    """
    if text is None:
        return ()
    try:
        size_m = tuple(float(part) for part in text.split(","))
    except ValueError:
        size_m = ()
    if len(size_m) not in (1, 2) or not all(0.0 < one < SOLE_MAX_M for one in size_m):
        raise UsageError(
            f"--sole-m {text!r} is no size of an insole",
            expected=f"LENGTH or LENGTH,WIDTH, in metres, below {SOLE_MAX_M:g}",
        )
    return size_m


def named_values(text: str | None, option: str) -> dict[str, str]:
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

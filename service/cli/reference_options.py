"""How a user states what a reference's file does not say itself: columns, units, sign, lag."""

from __future__ import annotations

from typing import Annotated

import typer

from devices.errors import UsageError

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
LagRange = Annotated[
    str | None,
    typer.Option(
        "--lag-range-s", metavar="A,B", help="Least and greatest lag, where several would fit."
    ),
]


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

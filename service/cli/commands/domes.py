"""`foottile domes`: load ranges of the paper's domes."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from devices.errors import UsageError
from service.cli.options import JsonOption, echo, print_json, stdout
from service.estimation.domes import (
    SlowSaturationLoad,
    compute_ambient_transmission,
    compute_fast_to_slow_saturation_load_ratio,
    list_saturation_loads,
    select_weakest_covering_dome,
)


def domes_command(
    load_n: Annotated[
        float | None, typer.Option(help="Greatest load on one tile, N: select a dome.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the domes of the paper's Table I and their load ranges.

    The paper states a range for one dome only, 11 mm of Vytaflex 60; the others are scaled by
    modulus and area, which is an estimate. Exit codes: 0 success, 2 wrong usage, 3 every dome
    saturates.
    """
    if load_n is not None and not 0.0 < load_n < float("inf"):
        raise UsageError(f"--load-n {load_n} is not a load", expected="newtons above 0")
    selected = None if load_n is None else select_weakest_covering_dome(load_n)
    if as_json:
        print_json(
            {
                "load_n": load_n,
                "dome": None if selected is None else selected.dome.name,
                "verdict": None
                if selected is None or load_n is None
                else selected.judge_slow_load(load_n),
                "basis": None if selected is None else selected.source,
                "fast_share": compute_fast_to_slow_saturation_load_ratio(),
                "domes": [
                    {
                        "name": found.dome.name,
                        "material": found.dome.material.name,
                        "modulus_mpa": found.dome.material.modulus_mpa,
                        "diameter_mm": found.dome.diameter_mm,
                        "range_n": [found.low_n, found.high_n],
                        "basis": found.source,
                        "external_share": compute_ambient_transmission(found.dome),
                        "verdict": None if load_n is None else found.judge_slow_load(load_n),
                    }
                    for found in list_saturation_loads()
                ],
            }
        )
    else:
        table = Table(
            box=SIMPLE_HEAD,
            pad_edge=False,
            padding=(0, 1, 0, 0),
            title="Domes",
            title_justify="left",
        )
        headings = ["dome", "material", "mm", "MPa", "full scale N", "from", "outside"]
        for heading in [*headings, *([] if load_n is None else [f"{load_n:g} N"])]:
            table.add_column(heading, no_wrap=True)
        for found in list_saturation_loads():
            table.add_row(
                found.dome.name,
                found.dome.material.name,
                f"{found.dome.diameter_mm:.0f}",
                f"{found.dome.material.modulus_mpa:.2f}",
                f"{found.low_n:.0f} to {found.high_n:.0f}",
                found.source,
                f"{100 * compute_ambient_transmission(found.dome):.0f} %",
                *([] if load_n is None else [found.judge_slow_load(load_n)]),
            )
        stdout.print(table)
        echo(_NOTES.format(fast=100 * compute_fast_to_slow_saturation_load_ratio()))
        if load_n is not None:
            echo(f"For {load_n:g} N: {_format_choice(selected, load_n)}")
    if load_n is not None and selected is None:
        raise typer.Exit(3)


_NOTES = """\
Full scale: slow load at which the chip reaches its 115 kPa. The paper states it for
v60-11; the others are scaled by modulus and area: test a dome before you rely on it.
A load within milliseconds reaches full scale at about {fast:.0f} % of it.
Outside: estimated part of a change of air or water pressure that a tile reads."""


def _format_choice(selected: SlowSaturationLoad | None, load_n: float) -> str:
    if selected is None:
        return "none of them; share the load between tiles."
    if selected.judge_slow_load(load_n) == "covers":
        return f"{selected.dome.name} ({selected.source})."
    return (
        f"perhaps {selected.dome.name}: it saturates somewhere between {selected.low_n:.0f} and "
        f"{selected.high_n:.0f} N ({selected.source})."
    )

"""`foottile domes`: load ranges of the paper's domes."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from devices.chips.pressure_chips import PRESSURE_CHIPS, get_chip
from devices.errors import UsageError
from service.cli.options import EXIT_INCOMPLETE, JsonOption, echo, print_json, stdout
from service.estimation.domes import (
    PAPER_CHIP,
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
    chip: Annotated[
        str, typer.Option(help="Kind of pressure chip, whose range ends a dome's.")
    ] = PAPER_CHIP.name,
    as_json: JsonOption = False,
) -> None:
    """List the domes of the paper's Table I and their load ranges.

    The paper states a range for one dome over its chip only, 11 mm of Vytaflex 60; the others are
    scaled, which is an estimate. Exit codes: 0 success, 2 wrong usage, 3 every dome
    saturates.
    """
    if load_n is not None and not 0.0 < load_n < float("inf"):
        raise UsageError(f"--load-n {load_n} is not a load", expected="newtons above 0")
    full_kpa = get_chip(chip).max_kpa
    selected = None if load_n is None else select_weakest_covering_dome(load_n, full_kpa)
    fast_share = compute_fast_to_slow_saturation_load_ratio(full_kpa)
    all_found = list_saturation_loads(full_kpa)
    if as_json:
        print_json(
            {
                "load_n": load_n,
                "chip": chip,
                "full_scale_kpa": full_kpa,
                "dome": None if selected is None else selected.dome.name,
                "verdict": None
                if selected is None or load_n is None
                else selected.judge_slow_load(load_n),
                "basis": None if selected is None else selected.source,
                "fast_share": fast_share,
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
                    for found in all_found
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
        for found in all_found:
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
        echo(_NOTES.format(chip=chip, kpa=full_kpa, fast=100 * fast_share))
        if load_n is not None:
            echo(f"For {load_n:g} N: {_format_choice(selected, load_n, full_kpa)}")
    if load_n is not None and selected is None:
        raise typer.Exit(EXIT_INCOMPLETE)


_NOTES = """\
Full scale: slow load at which the chip, {chip}, reaches its {kpa:g} kPa. The paper states it
for v60-11 to 115 kPa; the others are scaled: test a dome before you rely on it.
A load within milliseconds reaches full scale at about {fast:.0f} % of it.
Outside: estimated part of a change of air or water pressure that a tile reads."""


def _format_choice(selected: SlowSaturationLoad | None, load_n: float, full_kpa: float) -> str:
    if selected is None:
        wider = (
            f", or --chip {kind.name}"
            for kind in PRESSURE_CHIPS.values()
            if kind.max_kpa > full_kpa
        )
        return f"none of them; share the load between tiles{''.join(wider)}."
    if selected.judge_slow_load(load_n) == "covers":
        return f"{selected.dome.name} ({selected.source})."
    return (
        f"perhaps {selected.dome.name}: it saturates somewhere between {selected.low_n:.0f} and "
        f"{selected.high_n:.0f} N ({selected.source})."
    )

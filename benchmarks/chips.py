"""Both pressure chips on the same domes, loads and seeds: errors by look-ahead, and their causes.

    python benchmarks/chips.py --out DIR [--draws N] [--chip NAME]
    python benchmarks/chips.py --out DIR --plot docs/results/chips.png

Every draw calibrates its tiles with their chip on the emulated rig, and is a file in DIR, so that
the same command continues. A cause is switched off in the emulation and in the estimate: the error
falls by what it leaves. The direction of the push follows from the true forces.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from devices.scene.scene_file import Scene, load_scene, replace_chips
from service.estimation.calibration import Calibration
from service.offline.accuracy import MIN_GRF_N
from service.offline.figure_output import create_figure, render_png
from studies.benchmark.draws import (
    DrawRecording,
    compute_recording_accuracy,
    record_draw,
    record_with_calibration,
)

CHIPS = {"mpl115a2": "#D55E00", "bmp581": "#0072B2"}
SCENES = ("rolling", "poppy", "mud")
LAGS_MS = (0.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
CAUSES = {"gas": ("gas",), "creep": ("rubber",), "loop": ("hysteresis",)}
CAUSE_DRAWS = 3
CAUSE_LAG_MS = 10.0


def measure_draw(scene: Scene, chip: str, draw: int) -> dict[str, Any]:
    """Measure a draw by look-ahead; of the finer chip's first draws also without each cause."""
    recording = record_draw(scene, None, draw)
    figures: dict[str, Any] = {
        "rate_hz": recording.info.nominal_rate_hz,
        "push_mae_n": compute_push_error_n(recording),
        "by_lag_ms": {
            f"{lag_ms:g}": asdict(compute_recording_accuracy(recording, scene.models, lag_ms))
            for lag_ms in LAGS_MS
        },
    }
    if chip == "bmp581" and draw < CAUSE_DRAWS:
        every = tuple(name for names in CAUSES.values() for name in names)
        for cause, names in (*CAUSES.items(), ("all", every)):
            figures[f"without_{cause}"] = measure_without(scene, names, draw, recording.calibration)
    return figures


def compute_push_error_n(recording: DrawRecording) -> float:
    """Compute the mean error of a sum of true forces along the tiles' axes, in loaded frames."""
    true_n = recording.truth["true_grf_n"]
    error_n = np.abs(recording.truth["true_force_n"].sum(axis=1) - true_n)
    return float(error_n[true_n > MIN_GRF_N].mean())


def measure_without(
    scene: Scene, names: tuple[str, ...], draw: int, calibration: Calibration
) -> dict[str, float]:
    """Measure a draw whose domes lack effects, estimated without their models."""
    off = scene.model_copy(
        update={"emulation": scene.emulation.model_copy(update=dict.fromkeys(names, False))}
    )
    recording, _ = record_with_calibration(off, None, draw, calibration)
    models = tuple(name for name in scene.models if name not in names or name == "rubber")
    if "rubber" in names:  # its curve is that of settled forces, and is needed
        recording = replace(recording, calibration=remove_creep(calibration))
    accuracy = compute_recording_accuracy(recording, models, CAUSE_LAG_MS)
    return {"grf_mae_n": accuracy.grf_mae_n, "cop_p95_m": accuracy.cop_p95_m}


def remove_creep(calibration: Calibration) -> Calibration:
    """Return a calibration with the curves of settled forces, and no creep."""
    tiles = []
    for tile in calibration.tiles:
        rubber = tile.effects.rubber
        if rubber is not None:
            none = tuple(part.model_copy(update={"value": 0.0}) for part in rubber.part)
            rubber = rubber.model_copy(update={"part": none})
        effects = tile.effects.model_copy(update={"rubber": rubber})
        tiles.append(tile.model_copy(update={"effects": effects}))
    return calibration.model_copy(update={"tiles": tuple(tiles)})


def load_draws(folder: Path, chip: str, scene: str) -> list[dict[str, Any]]:
    """Load the results of a chip and scene."""
    return [json.loads(path.read_text()) for path in sorted(folder.glob(f"{chip}-{scene}-*.json"))]


def compute_medians(draws: list[dict[str, Any]], lag: str, name: str) -> list[float]:
    """Compute 5th percentile, median and 95th of a figure over draws."""
    values = [draw["by_lag_ms"][lag][name] for draw in draws]
    return [float(each) for each in np.percentile(values, (5, 50, 95))]


def format_table(folder: Path) -> str:
    """Format rate, errors and pooled coverage of every scene and chip, in Markdown."""
    head = "scene, chip, draws, frames/s, look-ahead, GRF N, peak N, COP mm, sigma N, saturated %, "
    head += "all %, flight, loading, mid, unloading, COP x"
    lines = [f"| {' | '.join(head.split(', '))} |", "|---|---|" + "--:|" * 14]
    for scene in SCENES:
        for chip in CHIPS:
            draws = load_draws(folder, chip, scene)
            for lag in ("10", "100"):
                by_draw = [draw["by_lag_ms"][lag] for draw in draws]
                low, middle, high = compute_medians(draws, lag, "grf_mae_n")
                counts = [each["grf_phases"] for each in by_draw]
                shares = [
                    sum(each[phase]["within"] for each in counts for phase in phases)
                    / sum(each[phase]["frames"] for each in counts for phase in phases)
                    for phases in (tuple(counts[0]), *((phase,) for phase in counts[0]))
                ]
                covered = [each["cop_covered"] for each in by_draw]
                shares.append(sum(c["within"] for c in covered) / sum(c["frames"] for c in covered))
                saturated = sum(d["saturated_frames"] for d in by_draw)
                cells = [
                    *(scene, chip, f"{len(draws)}", f"{draws[0]['rate_hz']:.0f}", f"{lag} ms"),
                    f"{middle:.3f} ({low:.3f}-{high:.3f})",
                    f"{compute_medians(draws, lag, 'peak_error_n')[1]:.2f}",
                    f"{1e3 * compute_medians(draws, lag, 'cop_p95_m')[1]:.2f}",
                    f"{compute_medians(draws, lag, 'grf_sigma_mid_stance_n')[1]:.2f}",
                    f"{100 * saturated / sum(d['frames'] for d in by_draw):.1f}",
                    *(f"{100 * share:.0f}" for share in shares),
                ]
                lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def list_causes(folder: Path, scene: str) -> dict[str, tuple[float, str]]:
    """List the finer chip's GRF error without each cause, beside the whole; and their colours."""
    whole = {chip: load_draws(folder, chip, scene) for chip in CHIPS}
    lag = f"{CAUSE_LAG_MS:g}"
    draws = [draw for draw in whole["bmp581"] if "without_all" in draw]
    numbers = [draw["by_lag_ms"][lag]["grf_mae_n"] for draw in draws]
    bars = {
        "MPL115A2": (
            compute_medians(whole["mpl115a2"][: len(draws)], lag, "grf_mae_n")[1],
            CHIPS["mpl115a2"],
        ),
        "BMP581": (float(np.median(numbers)), CHIPS["bmp581"]),
    }
    for cause in (*CAUSES, "all"):
        values = [draw[f"without_{cause}"]["grf_mae_n"] for draw in draws]
        name = "without all" if cause == "all" else f"without {cause}"
        bars[name] = (float(np.median(values)), "#8FC3E8")
    push_n = float(np.median([draw["push_mae_n"] for draw in draws]))
    return bars | {"push alone": (push_n, "#999999")}


def plot_chips(folder: Path) -> bytes:
    """Plot errors of both chips over the look-ahead, and what is left without each cause."""
    figure = create_figure(9.6, 8.4)
    panels = figure.subplots(3, len(SCENES), sharey="row")
    places = np.arange(len(LAGS_MS))
    for scene, column in zip(SCENES, panels.T, strict=True):
        for axes, (name, scale) in zip(
            column, (("grf_mae_n", 1.0), ("cop_p95_m", 1e3)), strict=False
        ):
            for chip, colour in CHIPS.items():
                draws = load_draws(folder, chip, scene)
                low, middle, high = (
                    scale
                    * np.array(
                        [compute_medians(draws, f"{lag_ms:g}", name) for lag_ms in LAGS_MS]
                    ).T
                )
                axes.fill_between(places, low, high, color=colour, alpha=0.15, linewidth=0)
                axes.plot(
                    places, middle, color=colour, marker="o", markersize=4, label=chip.upper()
                )
            axes.set_xticks(places, [f"{lag_ms:g}" for lag_ms in LAGS_MS])
            axes.set_xlabel("look-ahead, ms", fontsize=9)
        bars = list_causes(folder, scene)
        axes = column[2]
        for place, (value, colour) in enumerate(bars.values()):
            axes.bar(place, value, color=colour, width=0.72)
            axes.annotate(f"{value:.2f}", (place, value), ha="center", va="bottom", fontsize=8)
        axes.set_xticks(range(len(bars)), list(bars), rotation=40, ha="right", fontsize=8)
        column[0].set_title(scene, fontsize=12)
        for axes in column:
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(axis="y", color="#E6E6E6")
            axes.set_axisbelow(True)
            axes.tick_params(labelsize=8)
    for axes, label in zip(
        panels[:, 0],
        ("GRF error, N", "COP error, 95th percentile, mm", "GRF error at 10 ms, N"),
        strict=True,
    ):
        axes.set_ylabel(label, fontsize=9)
        axes.set_ylim(bottom=0.0)
    panels[0, 0].legend(frameon=False, fontsize=9)
    figure.suptitle(
        "Two pressure chips in the same domes, under the same loads.\n"
        "Lines: median of the draws; bands: 5 to 95 %. Light bars: the BMP581's error without the "
        "domes' gas, creep, loop;\nof the push's direction alone.",
        fontsize=10,
    )
    return render_png(figure)


def main() -> None:
    """Measure the missing draws, or print and plot all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--chip", choices=CHIPS, action="append")
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    if options.plot:
        print(format_table(options.out))
        options.plot.write_bytes(plot_chips(options.out))
        return
    options.out.mkdir(parents=True, exist_ok=True)
    for draw in range(options.draws):
        for chip in options.chip or CHIPS:
            for name in SCENES:
                path = options.out / f"{chip}-{name}-{draw:03d}.json"
                if not path.exists():
                    figures = measure_draw(replace_chips(load_scene(name), chip), chip, draw)
                    path.write_text(json.dumps(figures))
                    print(path.name, flush=True)


if __name__ == "__main__":
    main()

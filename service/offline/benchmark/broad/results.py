"""What is kept of one array, in a file of its own: written as it ends, so that a run goes on."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Literal

import pydantic

import devices
import service
import storage
from devices.errors import FootTileError
from devices.facts import Facts
from service.offline.accuracy import Covered
from storage.checked_json import read_checked, write_checked

Seeds = Literal["development", "judgement"]
FIRST_SEED: dict[Seeds, int] = {"development": 1_000_000, "judgement": 2_000_000}
"""Of array 0. No constant of the estimator may be set from an array of the second range."""


class Phase(Facts):
    """Frames of one phase: how many, how many covered, and sums of squares in N^2."""

    frames: int
    within: int
    sigma2: float
    error2: float

    @property
    def covered(self) -> Covered:
        """For pooling."""
        return Covered(self.frames, self.within)

    @property
    def sigma_over_rms(self) -> float:
        """Stated over actual error, both root mean square; NaN if there is none."""
        return math.sqrt(self.sigma2 / self.error2) if self.error2 else math.nan


class Judged(Facts):
    """One scene under one condition in one mode; None: nothing to judge.

    "Tile frames" are counted tile by tile. `wrongly`: the chip is within its range, and what the
    load would settle at is more than four times the noise below the calibrated end. `held`: the
    true force is at or above the stated bound.
    """

    frames: int
    grf_mae_n: float | None
    peak_error_n: float | None
    cop_p95_m: float | None
    flight_mean_n: float | None
    phases: dict[str, Phase]
    cop_frames: int
    cop_within: int
    saturated_frames: int
    saturated_tile_frames: int
    wrongly: int
    held: int
    grf_bounds: int
    grf_bounds_held: int
    after_frames: int
    after_within: int
    after_saturation_mae_n: float | None
    seconds: float
    """That were recorded."""
    alarms: int
    """How often a tile was said to be stuck, clipped or off its baseline. None is."""


class Tile(Facts):
    """What a tile is, and what its bench made of it.

    Attributes:
        serial: its name in the array.
        drawn: what the emulator drew, by name; an estimator does not know it.
        effect_n: how far each effect moves it on poppy seeds, 95th percentile of loaded frames.
        lacks: models that it has nothing for.
        given: models that its calibration offers.
        found: values of parameters, and their uncertainty as `NAME_sigma`.
        refused: models that it does not offer, with the reason.
        at_bound: parameters at the end of what is possible.
    """

    serial: str
    drawn: dict[str, float]
    effect_n: dict[str, float]
    lacks: tuple[str, ...]
    given: tuple[str, ...]
    found: dict[str, float]
    refused: dict[str, str]
    at_bound: tuple[str, ...]


class Refusal(Facts):
    """Something that gave no result, and why."""

    what: str
    why: str


class ArrayResult(Facts):
    """All of one array."""

    number: int
    seeds: Seeds
    made_by: str
    repeatability: float
    cpu_bench_s: float
    cpu_scenes_s: float
    tiles: tuple[Tile, ...]
    judged: dict[str, Judged]
    """By scene, condition and mode: `key_of`."""
    tiles_refused: int
    """By their bench; then the array gives nothing."""
    refusals: tuple[Refusal, ...]


def key_of(scene: str, condition: str, mode: str) -> str:
    """Name of one judgement."""
    return f"{scene}/{condition}/{mode}"


def code_id() -> str:
    """Hash of all of the project's code: results of another code are no results of this one."""
    digest = hashlib.sha256()
    for package in (devices, storage, service):
        (root,) = package.__path__
        for path in sorted(Path(root).rglob("*")):
            if path.suffix in (".py", ".toml"):
                digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def path_of(folder: Path, seeds: Seeds, number: int) -> Path:
    """Where an array's result is."""
    return folder / "arrays" / f"{seeds}-{number:05d}.json"


def write_result(folder: Path, result: ArrayResult) -> None:
    """Keep it.

    Raises:
        StorageError: the disk is full or not writable.
    """
    path = path_of(folder, result.seeds, result.number)
    write_checked(path, result.model_dump_json(indent=1).encode())


def read_result(path: Path) -> ArrayResult | None:
    """What is kept there; None if nothing is, or nothing whole: then it is made again."""
    try:
        return ArrayResult.model_validate_json(read_checked(path).text)
    except (FileNotFoundError, FootTileError, pydantic.ValidationError):
        return None

"""Result file of one array, written when it is done, so that an interrupted run can continue."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Literal

import devices
import service
import storage
from devices.errors import FootTileError
from devices.types import StrictModel
from service.offline.accuracy import CoverageCount
from storage.documents import read_document, write_document

Seeds = Literal["development", "judgement"]
FIRST_SEEDS: dict[Seeds, int] = {"development": 1_000_000, "judgement": 2_000_000}
"""Seed of array 0. Estimator constants must not be tuned on arrays of the "judgement" range."""


class PhaseCounts(StrictModel):
    """Counts of one phase: frames, covered frames, and sums of squares in N^2."""

    frames: int
    within: int
    sigma2: float
    error2: float

    @property
    def coverage(self) -> CoverageCount:
        """Coverage counts, for pooling."""
        return CoverageCount(self.frames, self.within)

    @property
    def sigma_over_rms(self) -> float:
        """Ratio of stated to actual RMS error; NaN without error."""
        return math.sqrt(self.sigma2 / self.error2) if self.error2 else math.nan


class CaseResult(StrictModel):
    """Errors and counts of one scene, condition and mode; None where no frame qualifies.

    "Tile frames" are counted by tile. `wrongly`: flagged as saturated although the chip is within
    its range and the settled pressure is more than four times the noise below the calibrated end.
    `held`: the true force is at or above the stated lower bound.
    """

    frames: int
    grf_mae_n: float | None
    peak_error_n: float | None
    cop_p95_m: float | None
    flight_mean_n: float | None
    phases: dict[str, PhaseCounts]
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
    """Recorded duration."""
    alarms: int
    """Number of false alarms: a tile flagged as stuck, clipped or off its baseline."""


class TileResult(StrictModel):
    """True properties of a tile, and those found on its rig.

    Attributes:
        serial: its name in the array.
        drawn: emulated parameters by name, hidden from the estimator.
        effect_n: size of each effect on poppy seeds, 95th percentile of loaded frames.
        lacks: models whose effect the tile does not have.
        given: models in its calibration.
        found: fitted parameters, and their uncertainty as `NAME_sigma`.
        refused: models not in its calibration, with the reason.
        at_bound: parameters at a limit of the fit.
    """

    serial: str
    drawn: dict[str, float]
    effect_n: dict[str, float]
    lacks: tuple[str, ...]
    given: tuple[str, ...]
    found: dict[str, float]
    refused: dict[str, str]
    at_bound: tuple[str, ...]


class RefusedItem(StrictModel):
    """Item without a result, and the reason."""

    what: str
    why: str


class ArrayResult(StrictModel):
    """Result of one array."""

    number: int
    seeds: Seeds
    made_by: str
    repeatability: float
    cpu_bench_s: float
    cpu_scenes_s: float
    tiles: tuple[TileResult, ...]
    judged: dict[str, CaseResult]
    """Results by scene, condition and mode; see `make_case_key`."""
    tiles_refused: int
    """Number of tiles refused by the calibration; the array then has no other results."""
    refusals: tuple[RefusedItem, ...]


def make_case_key(scene: str, condition: str, mode: str) -> str:
    """Return the key of a scene, condition and mode in `ArrayResult.judged`."""
    return f"{scene}/{condition}/{mode}"


def hash_project_code() -> str:
    """Hash the project's code; results of other code are not reused."""
    digest = hashlib.sha256()
    for package in (devices, storage, service):
        (root,) = package.__path__
        for path in sorted(Path(root).rglob("*")):
            if path.suffix in (".py", ".toml"):
                digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def get_result_path(folder: Path, seeds: Seeds, number: int) -> Path:
    """Return the path of an array's result file."""
    return folder / "arrays" / f"{seeds}-{number:05d}.json"


def write_result(folder: Path, result: ArrayResult) -> None:
    """Write an array's result file.

    Raises:
        StorageError: the disk is full or not writable.
    """
    path = get_result_path(folder, result.seeds, result.number)
    write_document(path, result)


def read_result(path: Path) -> ArrayResult | None:
    """Read a result file; None if it is missing or damaged."""
    try:
        return read_document(path, ArrayResult)
    except (FileNotFoundError, FootTileError):
        return None

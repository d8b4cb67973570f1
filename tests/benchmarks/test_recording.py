"""The benchmark of recordings still runs, and its bound is one. Nothing here is timed."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def recording(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("recording")


def part(name: str) -> ModuleType:
    return importlib.import_module(f"recording_{name}")


def tiny(recording: ModuleType, walk: Path) -> object:
    return recording.Extent(
        seconds=1.5, real_s=0.0, cost_s=3.0, sealed_s=1.5, sliced_s=10.0, turns=1, hours=0.001,
        with_ladder=False, walk=walk,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["sizes", "writing", "sealing", "slices"])
def test_every_section_gives_a_table(recording: ModuleType, tmp_path: Path, name: str) -> None:
    title, measure = recording.SECTIONS[name]
    lines = measure(tiny(recording, tmp_path / "nowhere"), tmp_path)
    assert title
    assert sum(line.startswith("|") for line in lines) > 3
    assert not any("nan" in line for line in lines)


def test_every_job_of_keeping_frames_is_measured_second_by_second(
    recording: ModuleType, tmp_path: Path
) -> None:
    costs, data = part("costs"), part("data")
    frames = data.lengthened(data.emulated(4, 1.5), 4.0, data.FULL_RATE_HZ)
    for found in (
        costs.append_costs(frames, tmp_path / "append", paced=False),
        costs.in_flight_costs(frames, tmp_path / "flight"),
    ):
        for cost in found.values():
            assert len(cost.cpu_s) >= 2
            assert min(cost.cpu_s) > 0.0


def test_a_long_journal_is_built_opened_read_and_sealed_whole(
    recording: ModuleType, tmp_path: Path
) -> None:
    hours, data = part("hours"), part("data")
    pattern = data.emulated(8, 1.5)
    with hours.SealedFileWriter(tmp_path / "pattern.parquet", pattern.info, {}) as writer:
        writer.append_frames(pattern.frames, {})
    steps = [hours.step(name, tmp_path, 0.001) for name in hours.STEPS]
    assert {step.frames for step in steps} == {round(3.6 * data.FULL_RATE_HZ)}


def test_the_code_of_the_bound_takes_what_such_numbers_must_take(recording: ModuleType) -> None:
    code_bits = part("entropy").code_bits
    rng = np.random.default_rng(0)
    n = 20_000
    assert code_bits(np.full(n, 7)) == 0.0
    for bits in (1, 4, 12, 20):
        taken = code_bits(rng.integers(0, 2**bits, n)) / n
        assert bits <= taken < bits + 0.3
    sigma = 20.0  # of Gaussian noise: log2(sigma sqrt(2 pi e)) bits
    taken = code_bits(np.rint(rng.normal(0.0, sigma, n)).astype(np.int64)) / n
    assert 6.37 - 0.05 < taken < 6.37 + 0.1

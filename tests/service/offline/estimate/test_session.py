"""A session estimated again: the same numbers to the bit, rounded or as computed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from service.offline.estimate.preparation import EstimateRequest
from service.offline.estimate.session import estimate_session
from service.sessions.estimate_stream import EstimateStream
from service.sessions.stances import load_stances
from storage.formats.export import make_one_pass_frame_source
from storage.formats.slice import Slice
from storage.schema import ESTIMATE_COLUMNS
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import PERIOD_NS
from tests.service.sessions.pieces import array, calibration, frames, hopping, options
from tests.storage.formats.exports import export

NAMES = [column.name for column in ESTIMATE_COLUMNS]


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session without estimates, with the calibration for them."""
    path = tmp_path_factory.mktemp("raw") / "raw.parquet"
    notes = {"calibration": calibration().model_dump(mode="json")}
    with SealedFileWriter(path, array(), notes) as writer:
        writer.append_frames(frames(hopping(3000, loaded_from=300), lead=200), {})
    return path


def estimated(source: Path, out: Path, *, unquantized: bool = False) -> SealedFileReader:
    estimate_session(source, out, request(unquantized=unquantized), on_remark=lambda _: None)
    return SealedFileReader(out)


def request(
    *, unquantized: bool = False, tare_s: tuple[float, float] | None = None
) -> EstimateRequest:
    return EstimateRequest(
        calibration=None,
        models=("static", "denoise"),
        lag_ms=100.0,
        scene=None,
        tare_s=tare_s,
        unquantized=unquantized,
    )


def estimates_of(reader: SealedFileReader) -> dict[str, np.ndarray]:
    pieces = list(reader.read_quantities(*NAMES))
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in NAMES}


def bits(columns: dict[str, np.ndarray]) -> dict[str, bytes]:
    return {name: values.tobytes() for name, values in columns.items()}


def test_estimated_again_from_its_own_file_a_session_has_the_same_content(
    raw: Path, tmp_path: Path
) -> None:
    with estimated(raw, tmp_path / "once.parquet") as once:
        with estimated(tmp_path / "once.parquet", tmp_path / "twice.parquet") as twice:
            assert once.content_sha256 == twice.content_sha256
            assert once.content_sha256 is not None
        with estimated(raw, tmp_path / "exact.parquet", unquantized=True) as exact:
            assert exact.notes["rounded_to"] == {}
            assert bits(estimates_of(exact)) != bits(estimates_of(once))
        with estimated(tmp_path / "exact.parquet", tmp_path / "rounded.parquet") as rounded:
            assert rounded.content_sha256 == once.content_sha256


def test_the_file_has_the_computed_values_rounded_to_its_stated_steps(
    raw: Path, tmp_path: Path
) -> None:
    batch = frames(hopping(3000, loaded_from=300), lead=200)
    stream = EstimateStream(array(), options(models=("static", "denoise"), lag_ms=100.0))
    pieces = [columns for _, columns in stream.estimate_batches([(batch, {})])]
    computed = {name: np.concatenate([piece[name] for piece in pieces]) for name in NAMES}
    with estimated(raw, tmp_path / "s.parquet") as reader:
        found, steps = estimates_of(reader), reader.notes["rounded_to"]
        said = {f.name: float((f.metadata or {}).get(b"rounded_to", 0)) for f in _fields(reader)}
    for name in NAMES:
        values = computed[name].reshape(len(batch), -1).T
        for i, (one, other) in enumerate(
            zip(values, found[name].reshape(len(batch), -1).T, strict=True)
        ):
            flat = f"{name}_{i}" if len(values) > 1 else name
            assert said[flat] == steps.get(flat, 0.0)
            whole = np.floor if name == "grf_lower_bound_n" else np.rint
            expected = whole(one / steps[flat]) * steps[flat] + 0.0 if flat in steps else one
            np.testing.assert_array_equal(other, expected.astype(other.dtype), err_msg=flat)


@pytest.mark.parametrize("unquantized", [False, True])
def test_a_session_estimated_in_its_folder_has_its_stances_beside_it(
    raw: Path, tmp_path: Path, unquantized: bool
) -> None:
    with estimated(raw, tmp_path / "frames.parquet", unquantized=unquantized):
        pass
    path = tmp_path / "stances.parquet"
    written = path.read_bytes()
    hops = load_stances(tmp_path).to_pylist()
    assert len(hops) == 90  # 2700 frames with a hop every 30
    assert all(hop["peak_grf_n"] > 30.0 for hop in hops)
    path.unlink()
    load_stances(tmp_path, store=True)
    assert path.read_bytes() == written
    with estimated(raw, tmp_path / "lone.parquet"):
        pass
    assert path.read_bytes() == written


def test_exports_say_to_what_their_columns_were_rounded(raw: Path, tmp_path: Path) -> None:
    with estimated(raw, tmp_path / "s.parquet") as reader:
        columns = [column.name for column in ESTIMATE_COLUMNS]
        content = make_one_pass_frame_source(reader.read_batches(*columns))
        part = Slice(columns=("grf_n", "contact"))
        out = tmp_path / "export.parquet"
        out.write_bytes(b"".join(export(content, reader.info, reader.notes, "parquet", part)))
        step = reader.notes["rounded_to"]["grf_n"]
    schema = pq.read_schema(out)
    assert (schema.field("grf_n").metadata or {})[b"rounded_to"] == repr(step).encode()
    assert b"rounded_to" not in (schema.field("contact").metadata or {})


def test_rounded_estimates_take_less_than_half_of_the_bytes(raw: Path, tmp_path: Path) -> None:
    estimated(raw, tmp_path / "s.parquet").close()
    estimated(raw, tmp_path / "exact.parquet", unquantized=True).close()
    rounded, exact = (_page_bytes(tmp_path / name) for name in ("s.parquet", "exact.parquet"))
    assert rounded < 0.5 * exact


def _page_bytes(path: Path) -> int:
    group = pq.ParquetFile(path).metadata.row_group(0)
    columns = [group.column(i) for i in range(group.num_columns)]
    return sum(c.total_compressed_size for c in columns if _is_estimate(c.path_in_schema))


def _is_estimate(flat: str) -> bool:
    return any(flat.startswith(name) for name in NAMES)


def _fields(reader: SealedFileReader) -> list[Any]:
    return list(reader.footer.schema)


def test_the_interval_of_the_tare_is_in_the_time_of_the_session_and_can_be_given_back(
    raw: Path, tmp_path: Path
) -> None:
    once = estimate_session(raw, tmp_path / "once.parquet", request(), on_remark=lambda _: None)
    begin_s, end_s = once.tare_s
    assert 0.0 <= begin_s < end_s
    given = request(tare_s=(max(0.0, begin_s - 1e-4), end_s + 1e-4))
    again = estimate_session(raw, tmp_path / "again.parquet", given, on_remark=lambda _: None)
    np.testing.assert_array_equal(again.plan.tare.baseline_kpa, once.plan.tare.baseline_kpa)
    assert again.tare_s == once.tare_s


def test_after_a_loaded_tare_the_ground_pulls_for_as_long_as_the_foot_is_unloaded(
    tmp_path: Path,
) -> None:
    load_n = np.where(np.arange(2500) // 500 % 2 == 1, 6.0, 0.0)
    forces_n = load_n[:, None] + np.random.default_rng(0).normal(0.0, 0.5, (2500, 2))
    raw, out = tmp_path / "raw.parquet", tmp_path / "out.parquet"
    notes = {"calibration": calibration().model_dump(mode="json")}
    with SealedFileWriter(raw, array(), notes) as writer:
        writer.append_frames(frames(forces_n, lead=400), {})
    found = [
        estimate_session(raw, out, request(tare_s=tare_s), on_remark=lambda _: None).findings.pull
        for tare_s in ((0.1, 0.9), (600 * PERIOD_NS * 1e-9, 900 * PERIOD_NS * 1e-9))
    ]
    assert found[0].duration_s == 0.0
    assert found[1].greatest_n == pytest.approx(12.0, abs=4.0)
    assert found[1].duration_s == pytest.approx(1500 * PERIOD_NS * 1e-9, rel=0.05)

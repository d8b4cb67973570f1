"""Two kinds of pressure chip on one foot: scene, frames, files and estimates."""

from __future__ import annotations

import io
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import pyxdf
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.io import loadmat

from devices.acquisition import RangeDetector
from devices.chips.bmp581 import BMP581
from devices.chips.mpl115a2 import MPL115A2
from devices.chips.pressure_chips import Compensation
from devices.errors import SceneError, UsageError
from devices.flags import TileFlag
from devices.frames import ArrayInfo, FrameBatch
from devices.scene.scene_file import Scene, load_scene, validate_scene
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.plan import make_plan
from service.offline.export import ExportOptions, export_session
from service.offline.simulation import EmulatedRun, SimulationOptions
from service.rig.emulated_foot import EmulatedFoot
from storage.formats.writers.registry import FORMATS
from storage.frame_rules import describe_first_broken_rule
from storage.journal.node.journal import NodeJournal
from storage.schema import wire_schema
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from storage.wire import EncodedBatch, decode_message, encode_frames
from tests.builders.arrays import make_array, make_tile
from tests.builders.calibrations import make_calibration, make_tare
from tests.builders.frames import assert_same_bits
from tests.storage.journal.node.leg import killed, take_in_flight
from tests.waiting import until


def make_scene(**second: object) -> Scene:
    """Two BMP581 on one channel, and an MPL115A2 on the next."""
    content = load_scene("standing").model_dump(mode="json", exclude_none=True)
    first, other, third, *_ = content["tile"]
    bmp581 = {"mux": 0x70, "channel": 0, "chip": "bmp581"}
    content["tile"] = [
        first | bmp581,
        other | bmp581 | {"address": 0x47} | second,
        third | {"mux": 0x70, "channel": 1},
    ]
    return validate_scene(content, where="test")


@pytest.fixture(scope="module")
def recording() -> tuple[ArrayInfo, FrameBatch, np.ndarray]:
    """A second of the mixed foot, with the true pressures."""
    with ExitStack() as stack:
        foot = EmulatedFoot(lead_s=0.2)
        run = EmulatedRun(SimulationOptions(make_scene(), seconds=1.0, foot=foot), stack)
        frames = FrameBatch.concatenate([batch for batch, _ in run.run_frames()])
        sampled_ns = frames.t_mono_ns[:, None] + 1000 * frames.sample_offset_us.astype(np.int64)
        true_kpa = [run.world.compute_dome_kpa(sampled_ns[:, i])[:, i] for i in range(3)]
        return run.info, frames, np.stack(true_kpa, axis=1)


def test_both_kinds_are_read_on_one_bus(
    recording: tuple[ArrayInfo, FrameBatch, np.ndarray],
) -> None:
    info, frames, true_kpa = recording
    assert [(t.chip, t.address) for t in info.tiles] == [
        ("bmp581", 0x46),
        ("bmp581", 0x47),
        ("mpl115a2", 0x60),
    ]
    assert info.tiles[0].registers[0] == 0x5032
    assert info.tiles[0].registers != info.tiles[1].registers
    assert not frames.tile_flags.any()
    assert frames.pressure_raw.dtype == np.uint32
    kpa = Compensation(info.tiles).compute_usable_kpa(frames)
    error_kpa = np.sqrt(np.mean((kpa - true_kpa) ** 2, axis=0))
    assert (error_kpa[:2] < 0.02).all(), "noise of 1 Pa, but instants known to half a millisecond"
    assert 0.1 < error_kpa[2] < 0.3
    assert describe_first_broken_rule(frames, info) == ""


def test_counts_beyond_a_chips_own_are_refused(
    recording: tuple[ArrayInfo, FrameBatch, np.ndarray],
) -> None:
    info, frames, _ = recording
    wrong = frames.copy()
    wrong.pressure_raw[5, 2] = 1024
    assert f"frame {int(frames.seq[5])}" in describe_first_broken_rule(wrong, info)


def test_wide_counts_survive_wire_and_file(
    recording: tuple[ArrayInfo, FrameBatch, np.ndarray], tmp_path: Path
) -> None:
    info, frames, _ = recording
    few = frames.slice_rows(0, 40)
    schema = wire_schema(info)
    assert_same_bits(decode_message(encode_frames(few, schema), schema), few)
    with SealedFileWriter(tmp_path / "s.parquet", info, {}) as writer:
        writer.append_frames(frames, {})
    with SealedFileReader(tmp_path / "s.parquet") as reader:
        read = FrameBatch.concatenate([batch for batch, _ in reader.read_batches()])
    assert read.pressure_raw.dtype == np.uint32
    assert_same_bits(read, frames)


def test_a_killed_node_has_lost_no_wide_count(
    recording: tuple[ArrayInfo, FrameBatch, np.ndarray], tmp_path: Path
) -> None:
    info, frames, _ = recording
    journal = NodeJournal(tmp_path / "node", "bench")
    journal.start_writer()
    stream = journal.switch_to_new_stream(info)
    stored = frames.slice_rows(0, 100)
    message = encode_frames(stored, wire_schema(info))
    journal.queue_batch_and_limit_memory(
        stream, EncodedBatch.from_frames_and_payload(stored, message)
    )
    until(lambda: stream.stored.last == 99)
    in_flight = frames.slice_rows(90, 120)
    in_flight.pressure_raw[20:, 0] = 125_500 * 64  # flagged when the batch is whole
    take_in_flight(stream.folder, in_flight, info)
    again = NodeJournal(killed(journal, tmp_path / "node"), "bench")
    again.start_writer()
    assert again.wait_for_ended_streams_on_disk()
    (found,) = again.streams
    assert found.journal is not None
    read = FrameBatch.concatenate(list(found.journal.read_frames(0, 119)))
    assert read.pressure_raw.dtype == np.uint32
    assert_same_bits(read.slice_rows(0, 110), frames.slice_rows(0, 110))
    assert (read.tile_flags[110:] == [TileFlag.OVER_RANGE, 0, 0]).all()
    again.end_streams_and_close()


def read_counts(to: str, path: Path) -> Any:
    """Pressure counts of all tiles, (n, 3), by each format's own reader."""
    names = [f"pressure_raw_{i}" for i in range(3)]
    if to == "mcap":
        reader = make_reader(io.BytesIO(path.read_bytes()), decoder_factories=[DecoderFactory()])
        found = reader.iter_decoded_messages(topics=["/emulated/frames"])
        return np.array([[getattr(each[3], name) for name in names] for each in found])
    if to == "mat":
        return loadmat(path)["pressure_raw"]
    if to == "xdf":
        streams, _ = pyxdf.load_xdf(path)
        (stream,) = (one for one in streams if one["info"]["name"] == ["emulated frames"])
        channels = stream["info"]["desc"][0]["channels"][0]["channel"]
        labels = [channel["label"][0] for channel in channels]
        return stream["time_series"][:, [labels.index(name) for name in names]]
    read = {
        "csv": pd.read_csv,
        "parquet": pd.read_parquet,
        "arrow": lambda path: pa.ipc.open_file(path).read_all().to_pandas(),
    }
    return read[to](path)[names].to_numpy()


@pytest.mark.parametrize("to", [name for name, one in FORMATS.items() if not one.needs_forces])
def test_each_format_has_the_counts_of_both_kinds(
    to: str, recording: tuple[ArrayInfo, FrameBatch, np.ndarray], tmp_path: Path
) -> None:
    info, frames, _ = recording
    with SealedFileWriter(tmp_path / "s.parquet", info, {}) as writer:
        writer.append_frames(frames, {})
    export_session(tmp_path / "s.parquet", tmp_path / "out", ExportOptions(to))
    np.testing.assert_array_equal(read_counts(to, tmp_path / "out"), frames.pressure_raw)


def test_the_end_of_each_chips_range_is_flagged(
    recording: tuple[ArrayInfo, FrameBatch, np.ndarray],
) -> None:
    info, frames, _ = recording
    pressed = frames.slice_rows(0, 4).copy()
    pressed.pressure_raw[:, 0] = [0, 29_999 * 64, 124_999 * 64, 125_001 * 64]
    RangeDetector(info.tiles).flag_out_of_range(pressed)
    over = TileFlag.OVER_RANGE
    assert pressed.tile_flags[:, 0].tolist() == [over, over, 0, over]
    assert (BMP581.min_kpa, BMP581.max_kpa) == (30.0, 125.0)


def test_estimates_take_range_law_and_warmth_of_each_chip(
    recording: tuple[ArrayInfo, FrameBatch, np.ndarray],
) -> None:
    info, frames, _ = recording
    compensation = Compensation(info.tiles)
    kpa = compensation.compute_usable_kpa(frames)
    tare = make_tare(
        3, baseline_kpa=kpa.min(axis=0), temperature_raw_counts=frames.temperature_raw.mean(axis=0)
    )
    plan = make_plan(info, make_calibration(*info.serials), tare, models=("static", "unwrap"))
    assert plan.params.tiles["rated_max_kpa"].tolist() == [125.0, 125.0, MPL115A2.max_kpa]
    estimator = ModelEstimator(plan)
    estimates = estimator.process_frames(frames)
    assert estimates is not None
    gauge_kpa = estimates.gauge_kpa
    assert gauge_kpa.tobytes() == (kpa - tare.baseline_kpa).tobytes()


def test_two_tiles_of_one_channel_need_two_addresses() -> None:
    with pytest.raises(SceneError, match="address 0x46 on mux 0x70 channel 0 is used by two"):
        make_scene(address=0x46)
    with pytest.raises(SceneError, match=r"0x60 is none of bmp581: 0x46, 0x47"):
        make_scene(address=0x60)


def test_a_chip_that_this_version_does_not_know_is_named() -> None:
    with pytest.raises(SceneError, match="no kind of chip, which are mpl115a2, bmp581"):
        make_scene(chip="bmp999", address=0x46)
    with pytest.raises(UsageError, match="unknown pressure chip 'bmp999'"):
        Compensation(make_array([make_tile(chip="bmp999")]).tiles)

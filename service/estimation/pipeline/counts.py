"""Loading of frames into the frame buffer: raw counts to pressures, gaps, instants of samples."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from devices.arrays import Times
from devices.chips import mpl115a2
from devices.chips.mpl115a2 import PRESSURE_MIN_KPA
from devices.flags import TileFlag
from devices.frames import NOT_READ
from devices.jit import jit_cached, jit_inlined
from devices.temperature_hold import HOLD_MAX_NS
from service.estimation.foot import LONG_GAP_NS
from service.estimation.foot.kinematics import store_servo_reading
from service.estimation.models.unwrap import unwrap_pressure
from service.estimation.pipeline.frame_buffer import FrameBuffer
from service.estimation.pipeline.params import KernelParams
from service.estimation.pipeline.state import FootState, TileState
from service.estimation.records import RecordArray

_UNUSABLE = int(TileFlag.UNUSABLE)
_OVER_RANGE = int(TileFlag.OVER_RANGE)
_kpa_of = jit_cached(mpl115a2.compensate_kpa_jit)
_kpa_per_count_of = jit_cached(mpl115a2.compute_kpa_per_padc_jit)


@jit_inlined
def append_frames_to_buffer(
    params: KernelParams,
    foot_state: FootState,
    tile_states: RecordArray[TileState],
    buffer: FrameBuffer,
    seq: npt.NDArray[np.uint64],
    t_mono_ns: Times,
    t_ns: Times,
    pressure_raw: npt.NDArray[np.uint16],
    temperature_raw: npt.NDArray[np.uint16],
    sample_offset_us: npt.NDArray[np.int32],
    servo_counts: npt.NDArray[np.int32],
    servo_age_us: npt.NDArray[np.int32],
    tile_flags: npt.NDArray[np.uint8],
    frame_flags: npt.NDArray[np.uint8],
) -> None:
    """Convert n frames to pressures and append them to the buffer; columns as in `FrameBatch`."""
    foot_params = params.foot[0]
    for k in range(len(seq)):
        i = foot_state.end_row
        row, now_ns = buffer.rows[i], t_mono_ns[k]
        row.seq, row.t_ns, buffer.t_mono_ns[i] = seq[k], t_ns[k], now_ns
        gap = long_gap = False
        if i > 0:  # a row of the frames before always remains
            passed_ns = now_ns - buffer.t_mono_ns[i - 1]
            # Unsigned throughout: a difference wraps, and any number is compared as it is.
            follows = np.uint64(seq[k] - buffer.rows[i - 1].seq) == np.uint64(1)
            gap, long_gap = not follows or passed_ns > foot_params.gap_ns, passed_ns > LONG_GAP_NS
        row.after_gap, row.after_long_gap = 1 if gap else 0, 1 if long_gap else 0
        foot_state.run_count += row.after_gap
        buffer.run[i] = foot_state.run_count
        if foot_params.has_servo == 1:
            store_servo_reading(
                buffer.readings, i, now_ns, int(servo_counts[k]), int(servo_age_us[k]),
                frame_flags[k], foot_params.counts_per_turn, gap,
            )  # fmt: skip
        for j in range(len(tile_states)):
            tile_params, tile_state = params.tiles[j], tile_states[j]
            sample = buffer.samples[i, j]
            flags = np.int64(tile_flags[k, j])
            sample.is_over_range = 1 if flags & _OVER_RANGE != 0 else 0
            sample.pressure_raw, sample.temperature_raw = pressure_raw[k, j], temperature_raw[k, j]
            if sample.temperature_raw == NOT_READ:  # a chip's temperature holds for a second
                if now_ns - tile_state.temperature_ns <= HOLD_MAX_NS:
                    sample.temperature_raw = tile_state.temperature_raw
            elif flags & _UNUSABLE == 0:
                tile_state.temperature_raw = sample.temperature_raw
                tile_state.temperature_ns = now_ns
            offset_ns = 1000 * np.int64(sample_offset_us[k, j])
            buffer.sampled_ns[i, j] = now_ns + offset_ns + tile_params.sample_delay_ns
            sample.pressure_kpa = math.nan
            is_read = sample.pressure_raw != NOT_READ and sample.temperature_raw != NOT_READ
            if flags & _UNUSABLE == 0 and is_read:
                p, t = float(sample.pressure_raw), float(sample.temperature_raw)
                chip = tile_params
                kpa = _kpa_of(p, t, chip.a0, chip.b1, chip.b2, chip.c12)
                if foot_params.has_unwrap == 1:
                    kpa = unwrap_pressure(kpa, _kpa_per_count_of(t, chip.b1, chip.c12))
                if kpa >= PRESSURE_MIN_KPA:
                    sample.pressure_kpa = kpa
        foot_state.newest_ns = now_ns
        foot_state.end_row += 1

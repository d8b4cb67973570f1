"""State of an estimate between frames: of every tile, and of the foot."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from devices.frames import NOT_READ
from service.estimation.fault_detection import baseline_loss, clipping, stuck, thermal_drift
from service.estimation.fault_detection.baseline_loss import BaselineLossState
from service.estimation.fault_detection.clipping import STATE as CLIPPING_STATE
from service.estimation.fault_detection.stuck import StuckState
from service.estimation.fault_detection.thermal_drift import ThermalDriftState
from service.estimation.foot.contact import ContactState
from service.estimation.models import ambient, flow, gas, hysteresis, rubber, skew, temperature
from service.estimation.models.ambient import AmbientState
from service.estimation.models.flow import FlowState
from service.estimation.models.gas import GasState
from service.estimation.models.hysteresis import HysteresisState
from service.estimation.models.rubber import RubberState
from service.estimation.models.skew import SkewState
from service.estimation.models.temperature import TemperatureState
from service.estimation.records import KernelRecord, Record, RecordArray


class DomeState(KernelRecord):
    """State of the models of a dome's forces."""

    flow: FlowState
    hysteresis: HysteresisState
    rubber: RubberState


class TileState(KernelRecord):
    """State of a tile."""

    temperature_raw: int  # last one that was read; `NOT_READ`: none
    temperature_ns: int  # instant of it
    previous_kpa: float  # as read in the frame before
    stuck: StuckState
    clipping: Annotated[Record, CLIPPING_STATE]
    baseline_loss: BaselineLossState
    thermal_drift: ThermalDriftState
    temperature: TemperatureState
    gas: GasState
    # Alternative hypothesis: the state after the load farthest from the best guess of all that are
    # possible, if the tile was saturated or had a gap.
    has_gas_alt: int
    gas_alt: GasState
    skew: SkewState
    dome: DomeState
    has_dome_alt: int
    dome_alt: DomeState
    previous_force_n: float  # force in the frame before, ...
    previous_force_ns: int  # ... and its instant
    has_previous_force: int


class FootState(KernelRecord):
    """State of the foot."""

    # Rows of the frame buffer: the first without an estimate, the first that the sample stage has
    # not processed, and the one after the last.
    release_row: int
    sample_row: int
    end_row: int
    newest_ns: int  # instant of the newest frame
    run_count: int  # gapless runs so far
    load_toggles: int  # loadings and unloadings of all tiles so far
    ambient: AmbientState
    contact: ContactState
    is_contact: int  # contact in the last estimate


def initial_state(tiles: int) -> tuple[RecordArray[FootState], RecordArray[TileState]]:
    """Make the states before the first frame: of the foot (1,), and of the tiles (tiles,)."""
    foot_state = FootState.array(1, ambient=ambient.initial_state())
    dome = DomeState.array(
        tiles,
        flow=flow.initial_state(tiles),
        hysteresis=hysteresis.initial_state(tiles),
        rubber=rubber.initial_state(tiles),
    )
    tile_states = TileState.array(
        tiles,
        temperature_raw=NOT_READ,
        previous_kpa=np.nan,
        stuck=stuck.initial_state(tiles),
        clipping=clipping.initial_clipping_state(tiles),
        baseline_loss=baseline_loss.initial_state(tiles),
        thermal_drift=thermal_drift.initial_state(tiles),
        temperature=temperature.initial_state(tiles),
        gas=gas.initial_state(tiles),
        skew=skew.initial_state(tiles),
        dome=dome,
    )
    return foot_state, tile_states

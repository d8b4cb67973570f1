"""Guided calibrations with known weights: started, followed, repeated and cancelled."""

from __future__ import annotations

from http import HTTPStatus
from math import isfinite
from typing import Annotated

from fastapi import APIRouter, Header
from pydantic import Field, StringConstraints

from devices.errors import UsageError
from devices.types import StrictModel
from service.api.routes.calibrations import check_fits
from service.api.routes.common import (
    FULL,
    NO_CONTENT,
    Name,
    ServerState,
    parse_if_match,
    problem_responses,
)
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.dead_weights import TOLERANCE_PERCENT, check_and_label_weights
from service.protocol.live import View
from service.server.node import ServerNode
from service.server.weighing import Method, StepName
from service.server.weighings import NodeWeighing, WeighingPlan, WeighingState
from service.user_folders import PublicText

router = APIRouter(prefix="/nodes/{node}/weighing", tags=["calibrations"])

_TILES_MAX, _WEIGHTS_MAX = 64, 60
_REFERENCES: dict[Method, str] = {
    "weights": "dead weights",
    "scale": "kitchen scale",
    "sensor": "force sensor",
}
_NONE = problem_responses(_404="No such node, or no guided calibration on it.")
_OTHER = problem_responses(_412="Another guided calibration is there than If-Match names.")

ThisOne = Annotated[
    str | None, Header(description="`session_id` of the guided calibration: only if it is this.")
]


class StartWeighing(StrictModel):
    """Tiles and weights."""

    tiles: Annotated[
        tuple[Annotated[str, StringConstraints(max_length=100)], ...],
        Field(min_length=1, max_length=_TILES_MAX),
    ] = Field(description="Serials, in the order in which they are loaded.", examples=[["T01"]])
    weights: Annotated[
        tuple[Annotated[str, StringConstraints(max_length=40 * _WEIGHTS_MAX)], ...],
        Field(min_length=1, max_length=_WEIGHTS_MAX),
    ] = Field(
        description="In the order in which they are put on each tile; five or more, in g, kg or N. "
        "A text may have several, with `;` or commas between; a comma between digits is decimal.",
        examples=[["200 g", "500 g", "1 kg", "1.5 kg", "2 kg"]],
    )
    within_percent: Annotated[float, Field(ge=0, le=50)] = Field(
        default=TOLERANCE_PERCENT, description="Tolerance of the weights that state none."
    )
    method: Method = Field(
        default="weights",
        description="Reference of the force: weights on the dome, the reading of a kitchen scale "
        "under the tile, or that of a force sensor.",
    )
    reference: Name | None = Field(
        default=None, description="The reference in words; default: by `method`."
    )
    name: Name | None = Field(default=None, description="Of the calibration; default: by tiles.")

    def plan(self) -> WeighingPlan:
        """Return the plan, with the tolerance of each weight.

        Raises:
            UsageError: a weight is none, or they are too few.
        """
        reference = self.reference or _REFERENCES[self.method]
        return WeighingPlan(
            tiles=self.tiles,
            weights=check_and_label_weights(self.weights, self.within_percent),
            method=self.method,
            reference=reference,
            name=self.name or f"{', '.join(self.tiles)}, {reference}"[:200],
        )


class RepeatabilityView(View):
    """Pressure of a step, in kPa; of a weight above the rest before it."""

    mean_kpa: float
    spread_kpa: float = Field(description="Standard deviation of quarter seconds.")
    settle_kpa: float = Field(description="Newest quarter second less the first.")


class TilePassView(View):
    """One tile, and its weights that are done."""

    serial: str
    held: list[RepeatabilityView] = Field(description="Of the first weights, in order.")


class WeightResultView(View):
    """One weight on a tile, and the curve there."""

    weight: str
    force_n: float
    gauge_kpa: float
    noise_kpa: float = Field(description="Standard deviation of a reading.")
    settle_kpa: float = Field(description="Last second less the first.")
    residual_n: float = Field(description="Force of the curve less that of the weight.")
    half_width_n: float = Field(description="Of the 95 % interval of another load like it.")


class BandView(View):
    """The curve at one pressure."""

    gauge_kpa: float
    force_n: float
    half_width_n: float = Field(description="Of the 95 % interval of a new loading.")


class TileResultView(View):
    """The curve of one tile."""

    serial: str
    weights: list[WeightResultView] = Field(description="Lightest first.")
    band: list[BandView]

    @classmethod
    def of(cls, tile: TileCalibration) -> TileResultView:
        """Return the result of a tile from its calibration."""
        facts = tile.weights
        steps = () if facts is None else sorted(facts.steps, key=lambda step: step.force_n)
        return cls(
            serial=tile.serial,
            weights=[
                WeightResultView(
                    **step.model_dump(),
                    half_width_n=facts.interpolate_half_width_95_n(step.gauge_kpa),
                )
                for step in steps
                if facts is not None
            ],
            band=[
                BandView(
                    gauge_kpa=point.gauge_kpa,
                    force_n=point.force_n,
                    half_width_n=point.new_loading_n,
                )
                for point in (() if facts is None else facts.band_95)
            ],
        )


class WeighingResultView(View):
    """The calibration that was fitted; the server keeps it."""

    calibration_id: str
    name: str
    date: str
    tiles: list[TileResultView]
    refused: dict[str, PublicText] = Field(description="Tiles without a curve, and why.")
    misfit: PublicText | None = Field(
        description="Why the node cannot be estimated with it; null: it can."
    )

    @classmethod
    def of(cls, calibration: Calibration, node: ServerNode) -> WeighingResultView:
        """Return the result of a calibration for the tiles of a node."""
        misfit = None
        bearing = [tile.serial for tile in node.last_info.tiles if not tile.reference]
        if missing := calibration.describe_missing_tiles(bearing):
            misfit = (
                f"{missing}. Calibrate all tiles in one go, or fit this recording and those of the "
                "other tiles with `foottile calibrate`"
            )
        else:
            try:
                check_fits(node, calibration)
            except UsageError as error:
                misfit = str(error)
        return cls(
            calibration_id=calibration.id,
            name=calibration.name,
            date=calibration.date,
            tiles=[TileResultView.of(tile) for tile in calibration.tiles],
            refused=calibration.refused,
            misfit=misfit,
        )


class WeighingView(View):
    """A guided calibration, under way or ended."""

    session_id: str = Field(description="Of its recording, by which it is told from others.")
    state: WeighingState
    tiles: list[TilePassView] = Field(description="In the order in which they are loaded.")
    weights: list[str] = Field(description="As markers have them.", examples=[["500 g +-1 %"]])
    method: Method
    reference: str
    name: str
    tile: str = Field(description="The tile under way.")
    step: StepName
    prompt: str = Field(description="Instruction for now.", examples=["Put 500 g on T02"])
    left_s: float | None = Field(description="Rest of the step; null between steps.")
    warning: str | None = Field(description="Why the last step is repeated.")
    problem: PublicText | None = Field(description="Why it failed, and what to do.")
    pressure_kpa: float | None = Field(
        description="Mean of the newest quarter second, above the last rest; null before one."
    )
    recent_kpa: list[float] = Field(
        description="Absolute pressure of the newest quarter seconds, up to 20 s."
    )
    rest_kpa: float | None = Field(description="Absolute pressure of the last rest.")
    repeatability: RepeatabilityView | None = Field(
        description="Of the step under way, or of the last one."
    )
    result: WeighingResultView | None = Field(description="Once it is done.")

    @classmethod
    def of(cls, weighing: NodeWeighing, node: ServerNode) -> WeighingView:
        """Make the view of a weighing in its present state."""
        now, plan, found = weighing.present_tile_pass, weighing.plan, weighing.calibration
        rest_kpa = now.rest_kpa if isfinite(now.rest_kpa) else None
        recent_kpa = [round(kpa, 3) for kpa in now.recent_kpa]
        seen = now.repeatability
        return cls(
            session_id=weighing.session_id,
            state=weighing.state,
            tiles=[TilePassView.model_validate(each) for each in weighing.passes],
            weights=list(plan.weights),
            method=plan.method,
            reference=plan.reference,
            name=plan.name,
            tile=now.serial,
            step=now.step,
            prompt=now.prompt,
            left_s=now.left_s,
            warning=weighing.warning,
            problem=weighing.problem,
            pressure_kpa=None
            if rest_kpa is None or not recent_kpa
            else round(recent_kpa[-1] - rest_kpa, 3),
            recent_kpa=recent_kpa,
            rest_kpa=rest_kpa,
            repeatability=None if seen is None else RepeatabilityView.model_validate(seen),
            result=None if found is None else WeighingResultView.of(found, node),
        )


class NodeWeighingView(View):
    """The guided calibration of a node."""

    node: str
    weighing: WeighingView | None = Field(
        description="Under way, or the last one; null: none since the server was started, or it "
        "was closed."
    )


@router.get(
    "", summary="Guided calibration of a node", responses=problem_responses(_404="No such node.")
)
async def get_weighing(node: str, server: ServerState) -> NodeWeighingView:
    """Return the state of the guided calibration; poll it while one is under way."""
    the_node = server.nodes.get(node)
    found = server.weighings.find(node)
    return NodeWeighingView(
        node=node, weighing=None if found is None else WeighingView.of(found, the_node)
    )


@router.post(
    "",
    summary="Start a guided calibration",
    status_code=HTTPStatus.CREATED,
    responses=problem_responses(
        FULL,
        _404="No such node.",
        _409="One is under way on this node, or the node cannot be recorded now.",
        _422="A weight is none, they are too few, or there is no such tile.",
    ),
)
async def start_weighing(node: str, body: StartWeighing, server: ServerState) -> WeighingView:
    """Record, follow the pressure of each tile, mark each weight, and fit: one per node at a time.

    It continues when the client that started it disconnects, and ends by itself when the node
    disconnects or no step is completed for ten minutes.
    """
    the_node = server.nodes.get(node)
    return WeighingView.of(server.weighings.start_with_recording(the_node, body.plan()), the_node)


@router.post(
    "/repeat",
    summary="Repeat a weight",
    responses=problem_responses(_NONE, _OTHER, FULL, _409="It has ended."),
)
async def repeat_weight(node: str, server: ServerState, if_match: ThisOne = None) -> WeighingView:
    """Go back to the weight that is held, or else to the last one on this tile."""
    the_node = server.nodes.get(node)
    return WeighingView.of(
        server.weighings.repeat_held_or_last_weight(the_node, parse_if_match(if_match)), the_node
    )


@router.delete(
    "",
    summary="Cancel or close a guided calibration",
    **NO_CONTENT,
    responses=problem_responses(_NONE, _OTHER),
)
async def end_weighing(node: str, server: ServerState, if_match: ThisOne = None) -> None:
    """Cancel a running calibration without a fit, or close an ended one; its recording stays."""
    await server.weighings.cancel_or_remove_weighing(node, parse_if_match(if_match))

"""One measurement of a node's clock against the server's."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class ClockOffset(BaseModel):
    """How far the server's UTC was from the `t_ns` of a stream, at one instant."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    boot_id: str
    t_mono_ns: int
    server_minus_node_ns: int
    uncertainty_ns: int
    """The truth is within plus or minus this: half the probe's round trip."""

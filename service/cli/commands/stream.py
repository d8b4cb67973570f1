"""`foottile stream`: live frames as lines, for other programs."""

from __future__ import annotations

import json
import os
import sys
from typing import TYPE_CHECKING, Annotated, BinaryIO

import typer

from devices.errors import UsageError
from service.cli.commands.sessions import SERVER, ColumnsOption, ServerOption
from service.cli.options import CaOption, remark

if TYPE_CHECKING:
    import pyarrow as pa

    from foottile import FrameLoss

FORMATS = ("csv", "jsonl")


def stream_command(
    node: Annotated[str | None, typer.Argument(help="Name of the node; the only one.")] = None,
    columns: ColumnsOption = None,
    to: Annotated[
        str, typer.Option("--format", help="csv, or jsonl: a line of JSON each.")
    ] = "csv",
    policy: Annotated[
        str,
        typer.Option(
            help="lossless: every frame, also over broken links; drop_oldest: not those that wait "
            "for more than 2 s; latest: the newest."
        ),
    ] = "lossless",
    frames: Annotated[
        int | None, typer.Option(min=1, max=2**53, help="End after so many; default: go on.")
    ] = None,
    server: ServerOption = None,
    ca: CaOption = None,
) -> None:
    """Print live frames of a node with their estimates, one line each, until Ctrl-C.

    Who reads may end it by going away, as in `foottile stream left | head`. What is lost is said on
    stderr.
    """
    import foottile
    from foottile.live_protocol import POLICIES

    if to not in FORMATS:
        raise UsageError(f"--format {to!r}", expected=" or ".join(FORMATS))
    chosen = next((known for known in POLICIES if known == policy), None)
    if chosen is None:
        raise UsageError(f"--policy {policy!r}", expected=", ".join(POLICIES))
    names = [name.strip() for name in (columns or "").split(",") if name.strip()]
    printed = 0
    lines = Lines(sys.stdout.buffer, to)
    try:
        with (
            foottile.connect(server or SERVER, ca=ca) as source,
            source.live(node, names, policy=chosen, on_loss=_say_lost) as live,
        ):
            for batch in live:
                rows = batch if frames is None else batch.slice(0, frames - printed)
                lines.write(rows)
                printed += rows.num_rows
                if printed == frames:
                    return
    except BrokenPipeError:  # who read has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:  # that is how it ends
        pass


class Lines:
    """Batches as lines of text.

    Args:
        sink: where they go; flushed after each batch.
        to: csv or jsonl.
    """

    def __init__(self, sink: BinaryIO, to: str) -> None:
        self._sink = sink
        self._is_csv = to == "csv"
        self._names: list[str] = []

    def write(self, batch: pa.RecordBatch) -> None:
        """Write its rows; of CSV the names first, and again when they change."""
        import pyarrow as pa
        import pyarrow.csv as pacsv

        if self._is_csv:
            options = pacsv.WriteOptions(
                include_header=batch.schema.names != self._names, quoting_style="needed"
            )
            pacsv.write_csv(pa.Table.from_batches([batch]), self._sink, options)
            self._names = batch.schema.names
        else:
            for row in batch.to_pylist():
                self._sink.write(json.dumps(row, separators=(",", ":")).encode() + b"\n")
        self._sink.flush()


def _say_lost(loss: FrameLoss) -> None:
    remark(str(loss))

"""`foottile stream`: live frames as lines of text for other programs."""

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

FORMATS = ("csv", "jsonl")


def stream_command(
    node: Annotated[
        str | None, typer.Argument(help="Name of the node; default: the only one.")
    ] = None,
    columns: ColumnsOption = None,
    to: Annotated[
        str, typer.Option("--format", help="csv, or jsonl: a JSON object per line.")
    ] = "csv",
    policy: Annotated[
        str,
        typer.Option(
            help="lossless: every frame, also across broken links; drop_oldest: drop frames after "
            "2 s; latest: the newest only."
        ),
    ] = "lossless",
    frames: Annotated[
        int | None, typer.Option(min=1, max=2**53, help="Number of frames; default: unlimited.")
    ] = None,
    server: ServerOption = None,
    ca: CaOption = None,
) -> None:
    """Print live frames of a node with their estimates, one line each, until Ctrl-C.

    It also ends with its reader, as in `foottile stream left | head`. Losses are reported on
    stderr.
    """
    import foottile
    from foottile.live import POLICIES

    if to not in FORMATS:
        raise UsageError(f"--format {to!r}", expected=" or ".join(FORMATS))
    policy_name = next((each for each in POLICIES if each == policy), None)
    if policy_name is None:
        raise UsageError(f"--policy {policy!r}", expected=", ".join(POLICIES))
    names = [name.strip() for name in (columns or "").split(",") if name.strip()]
    printed = 0
    lines = LineWriter(sys.stdout.buffer, to)
    try:
        with (
            foottile.connect(server or SERVER, ca=ca) as source,
            source.live(
                node, names, policy=policy_name, on_loss=lambda loss: remark(str(loss))
            ) as live,
        ):
            for batch in live:
                rows = batch if frames is None else batch.slice(0, frames - printed)
                lines.write(rows)
                printed += rows.num_rows
                if printed == frames:
                    return
    except BrokenPipeError:  # the reader has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:  # the regular end
        pass


class LineWriter:
    """Writer of batches as lines of text.

    Args:
        sink: output, flushed after each batch.
        to: csv or jsonl.
    """

    def __init__(self, sink: BinaryIO, to: str) -> None:
        self._sink = sink
        self._is_csv = to == "csv"
        self._names: list[str] = []

    def write(self, batch: pa.RecordBatch) -> None:
        """Write the rows of a batch; CSV has a header, repeated when the names change."""
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

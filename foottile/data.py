"""Frames of a session: nothing is fetched before it is asked for, and no more than that."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from foottile.errors import DamagedError, FootTileError, UsageError
from foottile.http import Http

if TYPE_CHECKING:
    import httpx

Clock = Literal["node", "server"]

_CHUNK = 1 << 16
_BEGIN, _END = b"ARROW1\0\0", b"ARROW1"
"""Of a file in Arrow's IPC format."""


@dataclass(frozen=True)
class Data:
    """Frames of a session, or a slice of them; the server cuts and sends only what is asked for.

    `data["grf_n"]` is a column as numpy, `data[["t_ns", "grf_n"]]` and `data[2.0:3.0]` (seconds
    from the session's first frame) are less of the same, and fetch nothing.

    Attributes:
        columns: names, of all tiles (`force_n`) or one (`force_n_0`); empty: all.
        start_s: from so many seconds after the first frame on; None: from the beginning.
        end_s: before so many seconds; None: to the end.
        clock: of `server` there are also `t_server_ns`, each frame's instant in the server's UTC,
            as markers have it, and its bound `t_server_uncertainty_ns`.
    """

    _http: Http
    session_id: str
    columns: tuple[str, ...] = ()
    start_s: float | None = None
    end_s: float | None = None
    clock: Clock = "node"

    @overload
    def __getitem__(self, what: str) -> npt.NDArray[Any]: ...
    @overload
    def __getitem__(self, what: slice | list[str] | tuple[str, ...]) -> Data: ...
    def __getitem__(
        self, what: str | slice | list[str] | tuple[str, ...]
    ) -> Data | npt.NDArray[Any]:
        """A column as numpy, [n] or [n, tiles]; or less of the same.

        Raises:
            UsageError: a slice with a step, or what is no column's name.
            FootTileError: as for `batches`.
        """
        if isinstance(what, str):
            columns = list(replace(self, columns=(what,)).numpy().values())
            return columns[0] if len(columns) == 1 else np.stack(columns, axis=1)
        if isinstance(what, slice):
            return self._between(what)
        names = tuple(what)
        if not names or not all(isinstance(name, str) for name in names):
            raise UsageError(f"{what!r} is no list of columns")
        return replace(self, columns=names)

    def batches(self) -> Iterator[pa.RecordBatch]:
        """The frames, some thousand at a time, as they come over the network.

        Raises:
            UsageError: there is no such column, or no such time in the session.
            FootTileError: no answer, no such session, or what came is damaged or broke off.
        """
        query = {
            "format": "arrow",
            "columns": ",".join(self.columns) or None,
            "start_s": self.start_s,
            "end_s": self.end_s,
            "clock": self.clock,
        }
        with self._http.stream(f"/sessions/{self.session_id}/data", query) as answer:
            # Buffered: Arrow takes a read that gives less than it asked for as the end.
            content = io.BufferedReader(_Reading(answer), _CHUNK)
            try:
                yield from _read_batches(content)
            except FootTileError:  # some are OSErrors, too
                raise
            except (pa.ArrowInvalid, OSError, EOFError) as error:
                raise DamagedError(
                    f"session {self.session_id} did not come whole: {error}"
                ) from error

    def arrow(self) -> pa.Table:
        """All of it as an Arrow table; units and descriptions are in its fields' metadata.

        Raises:
            FootTileError: as for `batches`.
        """
        batches = list(self.batches())
        if not batches:
            raise FootTileError(f"session {self.session_id} has no frame in this slice")
        return pa.Table.from_batches(batches)

    def pandas(self) -> Any:
        """All of it as a pandas DataFrame; what is not known is NaN.

        Raises:
            FootTileError: as for `batches`, or pandas is not installed.
        """
        try:
            return self.arrow().to_pandas()
        except ModuleNotFoundError as error:
            raise FootTileError("this needs pandas: pip install pandas") from error

    def numpy(self) -> dict[str, npt.NDArray[Any]]:
        """All of it as arrays by name, [n]; what is not known is NaN, also in columns of integers.

        Raises:
            FootTileError: as for `batches`.
        """
        table = self.arrow()
        return {name: table[name].to_numpy() for name in table.column_names}

    def _between(self, seconds: slice) -> Data:
        if seconds.step is not None:
            raise UsageError("a slice of seconds has no step: every frame is given")
        start_s = seconds.start if seconds.start is not None else self.start_s
        end_s = seconds.stop if seconds.stop is not None else self.end_s
        return replace(self, start_s=start_s, end_s=end_s)


def _read_batches(content: io.BufferedIOBase) -> Iterator[pa.RecordBatch]:
    """Read an Arrow file as it comes: behind its first bytes it is a stream.

    Raises:
        pa.ArrowInvalid, EOFError: it is damaged, or breaks off.
    """
    if content.read(len(_BEGIN)) != _BEGIN:
        raise EOFError("it is no Arrow file")
    with pa.ipc.open_stream(pa.PythonFile(content, mode="r")) as reader:
        yield from reader
    if not content.read().endswith(_END):
        raise EOFError("its end is missing")


class _Reading(io.RawIOBase):
    """An answer as a file that is read once."""

    def __init__(self, answer: httpx.Response) -> None:
        self._pieces = answer.iter_bytes(_CHUNK)
        self._left = memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        if not self._left:
            self._left = memoryview(next(self._pieces, b""))
        n = min(len(buffer), len(self._left))
        buffer[:n] = self._left[:n]
        self._left = self._left[n:]
        return n

"""A session as those who record it see it: over REST, and in the server's folder."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from devices.frames import FrameBatch
from storage.sessions.reader import SealedFileReader
from tests.waiting import PATIENCE_S, until

if TYPE_CHECKING:
    from tests.service.running import Running


def read_table(content: httpx.Response | bytes, to: str) -> pa.Table:
    """Read a file or a download in one of the formats of tables."""
    if isinstance(content, httpx.Response):
        assert content.status_code == 200, content.text
        content = content.content
    match to:
        case "parquet":
            return pq.read_table(io.BytesIO(content))
        case "arrow":
            return pa.ipc.open_file(content).read_all()
        case _:
            return pacsv.read_csv(io.BytesIO(content))


@dataclass(frozen=True)
class Recording:
    """A session of a server; `begun` is what the server said when it began."""

    running: Running
    begun: dict[str, Any]

    def __getitem__(self, name: str) -> Any:
        """A fact of the session as it began."""
        return self.begun[name]

    @property
    def id(self) -> str:
        return str(self.begun["id"])

    @property
    def url(self) -> str:
        return f"/sessions/{self.id}"

    @property
    def folder(self) -> Path:
        return self.running.data / "sessions" / self.id

    def now(self) -> dict[str, Any]:
        """The session as the server describes it now."""
        return self._answered(self.running.http.get(self.url))

    def ledger(self) -> dict[str, Any]:
        return self._answered(self.running.http.get(f"{self.url}/ledger"))

    def stop(self) -> dict[str, Any]:
        return self._answered(self.running.http.post(f"{self.url}/stop"))

    def sealed(self, timeout_s: float = PATIENCE_S) -> dict[str, Any]:
        """The session once it is sealed."""
        until(lambda: self.now()["state"] == "sealed", timeout_s)
        return self.now()

    def reader(self) -> SealedFileReader:
        return SealedFileReader(self.folder / "frames.parquet")

    def frames(self) -> FrameBatch:
        with self.reader() as file:
            return FrameBatch.concatenate([batch for batch, _ in file.read_batches()])

    def column(self, name: str) -> np.ndarray:
        path = self.folder / "frames.parquet"
        return pq.read_table(path, columns=[name])[name].to_numpy()

    def clock(self) -> dict[str, Any]:
        return self._answered(self.running.http.get(f"{self.url}/clock"))

    def data(self, **query: Any) -> httpx.Response:
        """A download."""
        answer = self.running.http.get(f"{self.url}/data", params=query)
        assert answer.status_code == 200, answer.text
        return answer

    @staticmethod
    def _answered(answer: httpx.Response) -> dict[str, Any]:
        assert answer.status_code == 200, answer.text
        content: dict[str, Any] = answer.json()
        return content


def parts_of(session: dict[str, Any]) -> list[tuple[str, int, int | None]]:
    """Stream, first and last number of every part."""
    return [(part["stream_id"], part["seq_first"], part["seq_last"]) for part in session["parts"]]


def whole_parts_of(session: dict[str, Any]) -> list[tuple[str, int, int | None]]:
    """The parts of a session of which nothing may be lacking."""
    assert session["complete"] is True
    return parts_of(session)

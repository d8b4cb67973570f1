"""A big sealed session of noise, and one who downloads it or adds a film, in their own process.

    python benchmarks/big_download.py URL [--mb-s 10] [--upload-mb 1000]

What is downloaded has the size of a session; what is in it does not matter to who sends it.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
from many_sessions import sealed
from served import TOKEN

from storage.documents import write_checksummed_json
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import FRAMES_NAME

PATIENCE_S = 30.0
_CHUNK_BYTES = 1 << 20


def big_session(data: Path, megabytes: float) -> str:
    """The path, below the API, of a sealed session's file of so many MB of noise."""
    session = sealed(1)
    path = data / "sessions" / session.id / FRAMES_NAME
    path.parent.mkdir(parents=True)
    with path.open("wb") as file:
        for _ in range(max(1, round(megabytes * 1e6 / _CHUNK_BYTES))):
            file.write(os.urandom(_CHUNK_BYTES))
    session = session.model_copy(
        update={"bytes": path.stat().st_size, "sha256": compute_sha256(path)}
    )
    write_checksummed_json(path.parent / "session.json", session.model_dump_json().encode())
    return f"/sessions/{session.id}/data?format=parquet"


def download(url: str, mb_s: float) -> None:
    """Read all of it, no faster than so many MB a second; 0: as fast as it comes."""
    began_s, size = time.monotonic(), 0
    with httpx.stream("GET", url, timeout=60.0, trust_env=False) as answer:
        answer.raise_for_status()
        for piece in answer.iter_raw(_CHUNK_BYTES):
            size += len(piece)
            if mb_s:
                time.sleep(max(0.0, began_s + size * 1e-6 / mb_s - time.monotonic()))
    took_s = time.monotonic() - began_s
    print(f"downloaded {size * 1e-6:.0f} MB in {took_s:.1f} s", flush=True)


def upload(url: str, megabytes: float, mb_s: float) -> None:
    """Add a film with so many MB behind it that players skip, as fast as `download` reads."""
    from tests.service.video.short_film import short_film

    size = round(megabytes * 1e6 / _CHUNK_BYTES) * _CHUNK_BYTES
    head, chunk = short_film() + struct.pack(">I4s", 8 + size, b"free"), os.urandom(_CHUNK_BYTES)
    began_s = time.monotonic()

    def pieces() -> Iterator[bytes]:
        yield head
        for sent in range(0, size, _CHUNK_BYTES):
            yield chunk
            if mb_s:
                time.sleep(max(0.0, began_s + sent * 1e-6 / mb_s - time.monotonic()))

    url = f"{url.partition('/data?')[0]}/videos?name=film.mp4"
    headers = {"Authorization": f"Bearer {TOKEN}", "Content-Length": str(len(head) + size)}
    with httpx.Client(timeout=600.0, trust_env=False) as client:
        client.post(url, content=pieces(), headers=headers).raise_for_status()
    print(f"added {size * 1e-6:.0f} MB in {time.monotonic() - began_s:.1f} s", flush=True)


async def begun(url: str, mb_s: float, upload_mb: float) -> asyncio.subprocess.Process:
    """Somebody else who downloads it, or adds a film to it."""
    command = [sys.executable, __file__, url, f"--mb-s={mb_s:g}", f"--upload-mb={upload_mb:g}"]
    return await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)


async def ended(process: asyncio.subprocess.Process) -> str:
    """What came of it."""
    try:
        return (await asyncio.wait_for(process.communicate(), PATIENCE_S))[0].decode().strip()
    except TimeoutError:
        process.kill()
        await process.wait()
        return "it was not finished"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("url")
    parser.add_argument("--mb-s", type=float, default=10.0, help="0: as fast as it goes")
    parser.add_argument("--upload-mb", type=float, default=0.0, help="add a film of so many MB")
    asked = parser.parse_args()
    if asked.upload_mb:
        upload(asked.url, asked.upload_mb, asked.mb_s)
    else:
        download(asked.url, asked.mb_s)


if __name__ == "__main__":
    main()

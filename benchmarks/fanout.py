"""What a message to a screen costs: `python benchmarks/fanout.py [VIEWERS [SECONDS [TURNS]]]`.

Servers in processes of their own take turns, each with the same viewers, 60 messages of the same
size a second to each. CPU time is the server's, per message delivered. Ours takes in a node of four
tiles at 500 frames/s meanwhile and estimates; that is measured without viewers before and after,
and the difference is beside the others, which do nothing else:

- uvicorn: Starlette on the same protocol, `send_bytes` to each viewer in turn;
- websockets: its asyncio server and `broadcast`;
- foxglove-sdk: its own server in Rust (extra `bench`; left out where it is not installed).
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import math
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import websockets.asyncio.client
import websockets.sync.client
from served import TOKEN, cpu_s

sys.path.insert(0, str(Path(__file__).parents[1]))

RATE_HZ = 60.0
FRAMES_PER_MESSAGE = 8  # more messages a second than screens are told of
TILES = 4
SETTLE_S = 1.0
_PROTOCOLS = {"ours": "foottile.v1", "foxglove-sdk": "foxglove.sdk.v1"}
_SUBSCRIBE = '{"op":"subscribe","subscriptions":[{"id":1,"channelId":1}]}'


# --- servers, each in a process of its own --------------------------------------------------------


def serve_ours(_: int) -> None:
    from service.cli.main import main

    with tempfile.TemporaryDirectory() as folder:
        sys.argv = ["foottile", "serve", "--port=0", f"--data={folder}"]
        main()


def serve_uvicorn(size: int) -> None:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.routing import WebSocketRoute
    from starlette.websockets import WebSocket, WebSocketDisconnect

    viewers: set[WebSocket] = set()

    async def live(socket: WebSocket) -> None:
        await socket.accept()
        viewers.add(socket)
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                await socket.receive_text()
        viewers.discard(socket)

    async def tell() -> None:
        async for payload in ticks(size):
            for socket in list(viewers):
                with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                    await socket.send_bytes(payload)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> Any:
        task = asyncio.create_task(tell())
        yield
        task.cancel()

    app = Starlette(routes=[WebSocketRoute("/", live)], lifespan=lifespan)
    with listening() as bound:
        config = uvicorn.Config(
            app, ws="websockets-sansio", ws_per_message_deflate=False, log_level="error"
        )
        uvicorn.Server(config).run(sockets=[bound])


def serve_websockets(size: int) -> None:
    from websockets.asyncio.server import broadcast, serve

    async def run() -> None:
        async def live(connection: Any) -> None:
            await connection.wait_closed()

        with listening() as bound:
            async with serve(live, sock=bound, compression=None) as server:
                async for payload in ticks(size):
                    broadcast(server.connections, payload)

    import uvloop

    uvloop.run(run())


def serve_foxglove(size: int) -> None:
    import foxglove

    server = foxglove.start_server(host="127.0.0.1", port=0)
    channel = foxglove.Channel("/live", message_encoding="json")
    print(f"http://127.0.0.1:{server.port}/", flush=True)
    payload, due_s = b"x" * size, time.monotonic()
    while True:
        channel.log(payload)
        due_s += 1 / RATE_HZ
        time.sleep(max(0.0, due_s - time.monotonic()))


async def ticks(size: int) -> Any:
    payload, due_s = b"x" * size, time.monotonic()
    while True:
        yield payload
        due_s += 1 / RATE_HZ
        await asyncio.sleep(max(0.0, due_s - time.monotonic()))


@contextlib.contextmanager
def listening() -> Iterator[Any]:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as bound:
        print(f"http://127.0.0.1:{bound.getsockname()[1]}/", flush=True)
        yield bound


SERVERS: dict[str, Callable[[int], None]] = {
    "ours": serve_ours,
    "uvicorn": serve_uvicorn,
    "websockets": serve_websockets,
    "foxglove-sdk": serve_foxglove,
}


# --- the other ends -------------------------------------------------------------------------------


@contextlib.contextmanager
def running(kind: str, size: int) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A server's process, and its address."""
    command = [sys.executable, __file__, "--serve", kind, str(size)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process.stdout as said:
        try:
            yield process, said.readline().split()[-1].rstrip("/")
        finally:
            process.terminate()
            process.wait(20.0)


@contextlib.contextmanager
def a_node(url: str) -> Iterator[None]:
    """A node that streams frames with a load that rises and falls."""
    from tests.service.fake_node import FakeNode

    def connected(path: str, **options: Any) -> Any:
        return websockets.sync.client.connect(
            url.replace("http", "ws") + path,
            proxy=None,
            compression=None,
            max_queue=None,
            subprotocols=[websockets.Subprotocol(_PROTOCOLS["ours"])],
            **options,
        )

    node = FakeNode(SimpleNamespace(socket=connected), tiles=TILES, token=TOKEN)  # type: ignore[arg-type]  # all it needs of a server here
    node.connect()
    node.send(60, lead=True)
    over = threading.Event()

    def stream() -> None:
        node.next_t_mono_ns = time.monotonic_ns()
        number = 0
        while not over.wait(max(0.0, (node.next_t_mono_ns - time.monotonic_ns()) * 1e-9)):
            node.send_again(node.frames(FRAMES_PER_MESSAGE, number % 40, alive=True))
            number += 1

    thread = threading.Thread(target=stream)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        node.close()


async def watched(
    kind: str, url: str, process: subprocess.Popen[str], viewers: int, seconds: float
) -> tuple[float, int, int]:
    """CPU seconds of the server, messages and bytes that came, in so long with so many viewers."""
    came = [0, 0]
    path = f"/api/v1/live?rate_hz={RATE_HZ:g}" if kind == "ours" else "/"

    async def look(socket: Any) -> None:
        async for message in socket:
            came[0] += 1
            came[1] += len(message)

    async with contextlib.AsyncExitStack() as stack:
        tasks = []
        for _ in range(viewers):
            socket = await stack.enter_async_context(
                websockets.asyncio.client.connect(
                    url.replace("http", "ws") + path,
                    proxy=None,
                    compression=None,
                    max_queue=None,
                    subprotocols=[websockets.Subprotocol(_PROTOCOLS[kind])]
                    if kind in _PROTOCOLS
                    else None,
                )
            )
            if kind == "foxglove-sdk":
                await socket.send(_SUBSCRIBE)
            tasks.append(asyncio.create_task(look(socket)))
        await asyncio.sleep(SETTLE_S)
        came[:] = 0, 0
        before_s = cpu_s(process.pid)
        await asyncio.sleep(seconds)
        took_s, found = cpu_s(process.pid) - before_s, tuple(came)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return took_s, found[0], found[1]


def measured(kind: str, size: int, viewers: int, seconds: float) -> tuple[float, float, float]:
    """Us CPU a message, share of messages delivered, and bytes of a message."""
    with running(kind, size) as (process, url), contextlib.ExitStack() as stack:
        alone_s = []
        if kind == "ours":
            stack.enter_context(a_node(url))
            time.sleep(2 * SETTLE_S)
            alone_s.append(asyncio.run(watched(kind, url, process, 0, seconds))[0])
        took_s, messages, size_bytes = asyncio.run(watched(kind, url, process, viewers, seconds))
        if kind == "ours":
            alone_s.append(asyncio.run(watched(kind, url, process, 0, seconds))[0])
            took_s -= statistics.mean(alone_s)
    share = messages / (viewers * RATE_HZ * seconds)
    return 1e6 * took_s / max(1, messages), share, size_bytes / max(1, messages)


def main() -> None:
    viewers, seconds, turns = 50, 5.0, 5
    given = [float(text) for text in sys.argv[1:]]
    viewers = int(given[0]) if given else viewers
    seconds = given[1] if len(given) > 1 else seconds
    turns = int(given[2]) if len(given) > 2 else turns
    kinds = [
        kind for kind in SERVERS if kind != "foxglove-sdk" or importlib.util.find_spec("foxglove")
    ]
    found: dict[str, list[tuple[float, float, float]]] = {kind: [] for kind in kinds}
    size = 0
    for turn in range(turns):
        for kind in kinds if not turn or turn % 2 == 0 else [*kinds[:1], *kinds[:0:-1]]:
            row = measured(kind, size, viewers, seconds)
            size = round(row[2]) if kind == "ours" else size
            found[kind].append(row)
    # A short run may take no tick of the processor's clock; then there is no ratio.
    beside = statistics.median(row[0] for row in found["uvicorn"]) or math.nan
    print(f"{viewers} viewers at {RATE_HZ:g} messages/s of {size} bytes,", end=" ")
    print(f"{turns} turns of {seconds:g} s\n")
    print("| server | us CPU a message | of uvicorn's | delivered % |")
    print("|---|--:|--:|--:|")
    for kind, rows in found.items():
        costs = [row[0] for row in rows]
        cost, share = statistics.median(costs), statistics.median(row[1] for row in rows)
        print(
            f"| {kind} | {cost:.1f} ({min(costs):.1f} to {max(costs):.1f}) | {cost / beside:.2f} "
            f"| {100 * share:.0f} |"
        )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        SERVERS[sys.argv[2]](int(sys.argv[3]))
    else:
        main()

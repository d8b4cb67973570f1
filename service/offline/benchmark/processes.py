"""Work in processes of its own: each result as it is there, and an end when we are told to end."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def spread(
    work: Callable[[Task], Result], tasks: Sequence[Task], jobs: int
) -> Iterator[tuple[Task, Result | Exception]]:
    """Every task with its result as it is finished.

    Where a process was killed, that breaks the pool: all tasks left come with the error.

    Args:
        work: a function of a module, that raises nothing it expects.
        tasks: what to call it with.
        jobs: so many processes at the same time; 1: in this one.
    """
    if jobs == 1:
        for task in tasks:
            yield task, work(task)
        return
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        with _interrupts_wait():
            pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_end_when_told)
            stack.enter_context(pool)
            stack.push(partial(_end_early, pool))
            futures = {pool.submit(_worked, work, task): task for task in tasks}
        for future in as_completed(futures):
            try:
                yield futures[future], future.result()
            except Exception as error:
                yield futures[future], error


def _end_early(pool: ProcessPoolExecutor, kind: type[BaseException] | None, *_: object) -> None:
    """After an error nobody waits for what is left."""
    if kind is not None:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()


@contextmanager
def _interrupts_wait() -> Iterator[None]:
    """Processes that are started meanwhile know no Ctrl-C: we tell them when to end.

    One that comes meanwhile is not lost, and finds no process half-started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # processes inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
    if came:
        raise KeyboardInterrupt


def _end_when_told() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))


def _worked(work: Callable[[Task], Result], task: Task) -> Result:
    try:
        return work(task)
    except SystemExit:
        os._exit(1)  # what it had open is cleaned up; the pool would give it another task

"""Work in parallel processes, spawned, because a Mitsuba session cannot be forked.

As with all spawned processes, a script that calls what uses this must guard its own start by
`if __name__ == "__main__":`.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

from .errors import OptionError, WorkerError

T = TypeVar("T")

_share: list[int] = []
"""In a worker: how many cores it has for itself."""


def cores() -> int:
    """How many cores this process may use: those that it may run on; in a worker, its share of them."""
    if _share:
        return _share[0]
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def is_worker() -> bool:
    """Whether this process is one of several that share the cores."""
    return bool(_share)


def keep_to(share: int) -> None:
    """This process is a worker, and has so many cores for itself."""
    _share[:] = [share]


def in_processes(
    work: Callable[[Any], T],
    jobs: Sequence[Any],
    workers: int | None,
    *,
    prepare: Callable[[], object] | None = None,
) -> Generator[tuple[int, T]]:
    """The index and the result of every job, as they end.

    Args:
        work: a function of a module; it and the jobs are pickled.
        jobs: its arguments.
        workers: processes, which share the cores; None: one per job, but no more than cores. 1 spawns none.
        prepare: what every process that is spawned does first; pickled.

    Raises:
        OptionError: fewer than one worker.
        WorkerError: a process died.
        MitsubaCRBError: whatever the work raises.
    """
    if workers is not None and workers < 1:
        raise OptionError(f"there must be at least one worker process, not {workers}")
    count = min(len(jobs), workers or cores())
    if count <= 1:
        yield from ((index, work(job)) for index, job in enumerate(jobs))
        return
    share = max(1, cores() // count)
    with ProcessPoolExecutor(
        count, get_context("spawn"), initializer=_begin, initargs=(share, prepare)
    ) as pool:
        with _interrupts_ignored():
            futures = {pool.submit(work, job): index for index, job in enumerate(jobs)}
        died: BrokenProcessPool | None = None
        try:
            for future in as_completed(futures):
                try:
                    result = future.result()
                except BrokenProcessPool as error:
                    died = error  # others have answered before
                    continue
                yield futures[future], result
        finally:
            pool.shutdown(cancel_futures=True)
        if died is not None:
            raise WorkerError(
                "a worker process ended before it had answered; with too little memory, use fewer --workers "
                "or a smaller size"
            ) from died


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Processes that start here are deaf to Ctrl-C while they import; only a main thread may arrange that."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _begin(share: int, prepare: Callable[[], object] | None) -> None:
    keep_to(share)
    # Ctrl-C reaches all processes of a terminal: the parent says so, once.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # A parent that is killed cannot say so: its workers would wait for ever.
    threading.Thread(target=_die_with_parent, daemon=True).start()
    if prepare is not None:
        prepare()


def _die_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

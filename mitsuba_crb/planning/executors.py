"""Where the work is done: in this process, in several of this machine, or where a Dask scheduler has workers.

All answer alike, in the order in which jobs end; what is found depends on none of them.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from ..errors import OptionError
from ..processes import in_processes
from ..render.backend import same_variant

T = TypeVar("T")


class Executor(Protocol):
    """What does jobs."""

    @property
    def elsewhere(self) -> bool:
        """Whether in other processes, so that work, jobs and results are pickled."""

    def close(self) -> None:
        """Let go of whoever does them."""

    def run(self, work: Callable[[Any], T], jobs: Sequence[Any]) -> Generator[tuple[int, T]]:
        """The index and the result of every job, as they end.

        Args:
            work: a function of a module, or a `functools.partial` of one.
            jobs: its arguments.

        Raises:
            WorkerError: whoever should do it is gone.
            MitsubaCRBError: whatever the work raises.
        """


@dataclass(frozen=True)
class Here:
    """One after another, in this process."""

    elsewhere: bool = False

    def close(self) -> None:
        """See `Executor`."""

    def run(self, work: Callable[[Any], T], jobs: Sequence[Any]) -> Generator[tuple[int, T]]:
        """See `Executor`."""
        yield from ((index, work(job)) for index, job in enumerate(jobs))


@dataclass(frozen=True)
class Processes:
    """In processes of this machine, which share its cores."""

    workers: int
    elsewhere: bool = True

    def close(self) -> None:
        """See `Executor`."""

    def run(self, work: Callable[[Any], T], jobs: Sequence[Any]) -> Generator[tuple[int, T]]:
        """See `Executor`."""
        return in_processes(work, jobs, self.workers, prepare=same_variant())


def executor_for(workers: int | None, scheduler: str | None) -> Executor:
    """Whoever was asked for.

    Args:
        workers: processes of this machine; None or 1: this one.
        scheduler: address of a Dask scheduler.

    Raises:
        OptionError: fewer than one worker, or workers of a scheduler's.
        WorkerError: nobody answers there.
        StoreError: Dask is not installed.
    """
    if scheduler is not None and workers is not None:
        raise OptionError("a scheduler has workers of its own: leave out --workers or --scheduler")
    if scheduler is not None:
        from .dask_cluster import DaskCluster

        return DaskCluster.at(scheduler)
    if workers is not None and workers < 1:
        raise OptionError(f"there must be at least one worker process, not {workers}")
    return Here() if workers in (None, 1) else Processes(int(workers or 1))


def this_worker() -> str:
    """What to call the process that asks."""
    distributed = sys.modules.get("distributed")
    if distributed is not None:
        try:
            worker = distributed.get_worker()
        except ValueError:  # of somebody who is none
            pass
        else:
            return f"worker {worker.name} at {worker.address}"
    return f"worker process {os.getpid()}"

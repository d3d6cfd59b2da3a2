"""Work on the machines of a Dask scheduler: `dask scheduler` on one, `dask worker tcp://…` on all.

Dask gives the jobs of a worker that dies to others. What it does not say in time is asked for here: whether
the scheduler is still there, and whether it has any workers left.
"""

from __future__ import annotations

import functools
import logging
import queue
import re
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from .. import processes
from ..errors import MitsubaCRBError, WorkerError
from .view_field import field_library

T = TypeVar("T")

PATIENCE = 5.0
"""Seconds until a scheduler that does not answer is not there, and one without workers has none."""


@dataclass(frozen=True)
class DaskCluster:
    """The workers of a scheduler."""

    address: str
    client: Any
    """`distributed.Client`."""
    elsewhere: bool = True

    @staticmethod
    def at(address: str) -> DaskCluster:
        """Whatever answers at an address.

        Raises:
            WorkerError: nothing does, or it has no workers.
            StoreError: Dask is not installed.
        """
        distributed = field_library("distributed")
        if not re.fullmatch(r"(tcp|tls|ucx|ws|wss)://\S+:\d+", address):
            raise WorkerError(
                f"--scheduler {address!r} is no address of a scheduler, such as tcp://192.168.0.2:8786"
            )
        # It says in many lines what is said below in one.
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        soon = {"distributed.comm.timeouts.connect": f"{PATIENCE}s"}
        try:
            with field_library("dask").config.set(soon):
                client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise WorkerError(
                f"no scheduler answers at {address} ({type(error).__name__}); start one with `dask scheduler`"
            ) from None
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            client.close(timeout=1)
            raise WorkerError(
                f"the scheduler at {address} has no workers; start some with `dask worker {address} "
                "--nthreads 1`"
            ) from None
        return DaskCluster(address, client)

    def run(self, work: Callable[[Any], T], jobs: Sequence[Any]) -> Generator[tuple[int, T]]:
        """See `Executor`."""
        distributed = field_library("distributed")
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        waiting = {}
        on_worker = functools.partial(_on_worker, work)
        try:
            for index, job in enumerate(jobs):
                future = self.client.submit(on_worker, job, pure=False)
                waiting[future] = index
                future.add_done_callback(ended.put)
            while waiting:
                try:
                    future = ended.get(timeout=PATIENCE)
                except queue.Empty:
                    if not self._workers():
                        raise WorkerError(f"the scheduler at {self.address} has no workers left") from None
                    continue
                index = waiting.pop(future)
                result = _result(future, distributed)
                future.release()
                yield index, result
        finally:
            with suppress(Exception):  # of a scheduler that is gone
                self.client.cancel(list(waiting), force=True)

    def close(self) -> None:
        """See `Executor`."""
        with suppress(Exception):
            self.client.close(timeout=1)

    def _workers(self) -> int:
        """How many there are.

        Raises:
            WorkerError: the scheduler is gone.
        """
        try:
            if self.client.status != "running":
                raise OSError(self.client.status)
            return len(self.client.scheduler_info()["workers"])
        except (OSError, TimeoutError) as error:
            raise WorkerError(f"the scheduler at {self.address} does not answer any more") from error


def _on_worker(work: Callable[[Any], T], job: Any) -> T:
    """In a worker: it keeps to the threads that it was started with."""
    processes.keep_to(field_library("distributed").get_worker().state.nthreads)
    return work(job)


def _result(future: Any, distributed: Any) -> Any:
    try:
        return future.result()
    except MitsubaCRBError:
        raise
    except distributed.KilledWorker as error:
        raise WorkerError(
            "workers ended again and again before they had answered; with too little memory, use fewer on a "
            "machine, or a smaller size"
        ) from error
    except ImportError as error:
        raise WorkerError(f"a worker has another version or lacks a package: {error}") from error
    except (distributed.CancelledError, OSError) as error:
        raise WorkerError("the scheduler is gone, and with it what it had not answered") from error

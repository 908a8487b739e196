"""Execution of many small tasks: in threads or processes of this computer, or on a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from errormotion.errors import RunError

if TYPE_CHECKING:
    from distributed import Client

SCHEDULERS = ("threads", "processes", "sync")
CPU_COUNT = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
CLUSTER_TIMEOUT = 15.0
"""Time limit for the connection to a cluster and its first worker, s."""

Done = Callable[[int, Any], None]
Lost = Callable[[int, str], None]


def checked_scheduler(wanted: str) -> str:
    """Return the name of a scheduler, or the address of one of Dask.

    Raises
    ------
    RunError
        There is no such scheduler.
    """
    if "://" not in wanted and wanted not in SCHEDULERS:
        raise RunError(
            f"Expected {', '.join(SCHEDULERS)} or the address of a Dask scheduler, such as tcp://host:8786; "
            f"found '{wanted}'",
            code="scheduler.unknown",
        )
    return wanted


def one_thread_at_a_time() -> bool:
    """Return whether numba's parallel kernels may be called from only one thread at a time."""
    import numba

    numba.get_num_threads()  # selects the layer
    return bool(numba.threading_layer() == "workqueue")  # type: ignore[attr-defined, unused-ignore]


@dataclass(frozen=True)
class _Answer:
    number: int
    value: Any


def _answer(number: int, function: Callable[..., Any], task: tuple[Any, ...]) -> _Answer:
    return _Answer(number, function(*task))


class Workers:
    """Threads, processes or a cluster, for one or several lists of tasks; a context manager.

    Parameters
    ----------
    scheduler : str
        ``threads``, ``processes``, ``sync`` (one after another), or the address of a Dask scheduler.
    workers : int, optional
        Number of threads or processes; default one for each processor. Not for a cluster.
    version : str
        Version of errormotion that the workers of a cluster must have.

    Raises
    ------
    RunError
        An unknown scheduler; a cluster that does not answer or has other versions, or Dask is not installed.
    """

    def __init__(self, scheduler: str, workers: int | None, version: str) -> None:
        self.scheduler = checked_scheduler(scheduler)
        if workers is not None and (workers < 1 or scheduler not in SCHEDULERS):
            raise RunError(
                f"--workers: expected 1 or more, and no number for a cluster; found {workers}",
                code="scheduler.workers.count",
            )
        self.count = 1 if scheduler == "sync" else workers or CPU_COUNT
        self._version = version
        self._executor: Executor | None = None
        self._client: Client | None = None

    def __enter__(self) -> Self:
        if self.scheduler == "threads":
            self._executor = ThreadPoolExecutor(self.count)
        elif self.scheduler == "processes":
            self._executor = ProcessPoolExecutor(
                self.count, multiprocessing.get_context("spawn"), _start_process, (max(1, CPU_COUNT // self.count),)
            )
        elif self.scheduler != "sync":
            self._client = _connected(self.scheduler, self._version)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
        if self._client is not None:
            self._client.close()

    def run(self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], done: Done, lost: Lost) -> None:
        """Execute ``function(*task)`` for all tasks; call ``done`` with the number and the value of each, in any order.

        ``lost`` is called with the number of a task whose process ended, and the reason.
        """
        if self._client is not None:
            self._on_cluster(function, tasks, done, lost)
        elif self._executor is not None:
            self._locally(function, tasks, done, lost)
        else:
            for number, task in enumerate(tasks):
                done(number, function(*task))

    def _locally(self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], done: Done, lost: Lost) -> None:
        executor: Any = self._executor
        ended = "the process ended unexpectedly (use fewer --workers if memory is short); repeat the command"
        futures, unfinished = {}, set(range(len(tasks)))
        try:
            for number, task in enumerate(tasks):
                futures[executor.submit(function, *task)] = number
            for future in as_completed(futures):
                number = futures.pop(future)
                value = future.result()
                unfinished.remove(number)
                done(number, value)
        except BrokenProcessPool:
            for number in sorted(unfinished):
                lost(number, ended)

    def _on_cluster(
        self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], done: Done, lost: Lost
    ) -> None:
        from dask.delayed import delayed
        from distributed import as_completed as completed

        client: Any = self._client
        futures = client.compute([delayed(_answer, pure=False)(n, function, task) for n, task in enumerate(tasks)])
        number_of = {future: number for number, future in enumerate(futures)}
        for future in completed(futures, loop=client.loop):
            if future.status == "finished":
                answer = future.result()
                done(answer.number, answer.value)
            else:  # the error handling of the task was not reached: a worker ended, or lacks errormotion
                lost(number_of[future], f"the cluster did not execute it: {future.exception() or future.status}")


def _start_process(threads: int) -> None:
    """Set up a process: its number of threads; Ctrl-C is handled by the parent process."""
    threading.Thread(target=_end_with_parent, name="errormotion-parent", daemon=True).start()
    os.environ.setdefault("NUMBA_NUM_THREADS", str(threads))
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _end_with_parent() -> None:
    """End this process if its parent was killed; the queue does not close, because the other workers keep it open."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _connected(address: str, version: str) -> Client:
    """Return a client of a Dask scheduler that has workers, all with this version of errormotion."""
    try:
        import dask  # noqa: F401
        from distributed import Client
    except ImportError as error:
        raise _missing("distributed") from error
    try:
        client = Client(address, timeout=CLUSTER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise RunError(
            f"{address}: expected a Dask scheduler; none answers ({error})", code="scheduler.no_answer"
        ) from error
    try:
        _check_workers(client, address, version)
    except BaseException:
        client.close()
        raise
    return client


def _check_workers(client: Client, address: str, version: str) -> None:
    """Raise RunError for a cluster without workers, or whose workers have another version of errormotion."""
    try:
        client.wait_for_workers(1, timeout=CLUSTER_TIMEOUT)
    except TimeoutError as error:
        raise RunError(
            f"{address}: the Dask scheduler has no workers; start some with 'dask worker {address}'",
            code="scheduler.no_workers",
        ) from error
    versions: Any = client.get_versions(packages=["errormotion"])
    wrong = [
        f"{worker} has {found['packages'].get('errormotion') or 'none'}"
        for worker, found in versions["workers"].items()
        if found["packages"].get("errormotion") != version
    ]
    if wrong:
        raise RunError(
            f"{address}: expected errormotion {version} on every worker; {', '.join(wrong)}. Install it there.",
            code="scheduler.version.differs",
        )


def _missing(package: str) -> RunError:
    return RunError(
        f"A cluster needs the package '{package}', which is not installed: "
        "pip install 'errormotion[cluster]'. This computer needs none: --scheduler processes, threads or sync.",
        code="package.missing",
    )

"""Parallel maps: serial, over threads or processes, or on a Dask cluster."""

import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from multiprocessing import get_context
from typing import Any, TypeAlias, TypeVar

from hilctl.base.errors import InputError
from hilctl.base.subprocesses import safe_import_path

Task = TypeVar("Task")
Result = TypeVar("Result")
SCHEDULERS = ("none", "threads", "processes")

MapFunction: TypeAlias = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[Any]]
"""Runs a function on each task and yields the results in the order of the tasks; ``map`` does."""


def parallel_map(function: Callable[[Task], Result], tasks: Iterable[Task], /) -> list[Result]:
    """Return ``[function(task) for task in tasks]``, computed by threads on all cores.

    For short parts of one fit that spend their time in ``nogil`` kernels and BLAS. A part must not
    call this function itself.
    """
    unwanted = getattr(_worker, "unwanted", None)
    if unwanted is not None and unwanted.is_set():
        raise _UnwantedError
    return list(_threads().map(function, tasks))


class _UnwantedError(Exception):
    """Cancels a fit whose result is no longer needed."""


_worker = threading.local()
"""Has an event ``unwanted`` in threads of :func:`workers`, which cancels their tasks."""


@cache
def _threads() -> ThreadPoolExecutor:
    usable = (
        os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    )
    return ThreadPoolExecutor(len(usable), "hilctl-fit")


@contextmanager
def workers(scheduler: str = "none") -> Iterator[MapFunction]:
    """Yield a :data:`MapFunction`; results do not depend on the scheduler.

    It is ``none`` for serial, ``threads`` or ``processes`` on this machine, or the address of a
    Dask scheduler, such as ``tcp://host:8786``, whose workers need the same hilctl. Raise
    InputError if it is unknown, cannot be reached, or Dask is not installed.
    """
    if scheduler == "none":
        yield map  # serial
    elif scheduler == "processes":  # spawned: a fork would copy BLAS's threads
        spawn = get_context("spawn")
        with safe_import_path(), ProcessPoolExecutor(mp_context=spawn) as processes:
            yield processes.map
    elif scheduler == "threads":
        unwanted = threading.Event()
        initial = _worker, "unwanted", unwanted
        with ThreadPoolExecutor(initializer=setattr, initargs=initial) as threads:
            try:
                yield threads.map
            except BaseException:
                unwanted.set()  # Ctrl-C does not wait for fits to end
                raise
    elif "://" in scheduler:
        with _dask(scheduler) as distributed:
            yield distributed
    else:
        known = f"{', '.join(SCHEDULERS)} or an address such as tcp://host:8786"
        raise InputError(f"scheduler must be {known}: {scheduler!r}")


@contextmanager
def _dask(address: str) -> Iterator[MapFunction]:
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            f"--scheduler {address} needs Dask: install it with pip install 'hilctl[scale]'"
        ) from None
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers at {address}: {error}") from None
    with client:
        yield client.get_executor(pure=False).map

"""Work shared out over processes or a cluster finds the same."""

import importlib.util
import math
import os
import threading

import pytest

from hilctl.base.errors import InputError
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_model import fit_model
from hilctl.lab.identify.parallel import _threads, parallel_map, workers
from hilctl.lab.identify.settings import FitSettings


def test_threads_need_no_affinity(monkeypatch):
    """Only Linux says which CPUs a process may use."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    _threads.cache_clear()
    assert parallel_map(abs, [-1, -2]) == [1, 2]
    _threads.cache_clear()


def test_short_parts_run_beside_each_other_and_keep_their_order():
    cores = len(os.sched_getaffinity(0))
    together = threading.Barrier(cores)

    def met(part: int) -> int:
        together.wait(timeout=60.0)
        return 2 * part

    assert parallel_map(met, range(cores)) == [2 * part for part in range(cores)]
    with pytest.raises(ZeroDivisionError):
        parallel_map(lambda part: 1 // part, [1, 0])


def test_fits_that_nobody_waits_for_end():
    """A Ctrl-C, or the error of one of them, need not wait until all others are done."""
    begun, ended = threading.Event(), []

    def fit(number: int) -> None:
        if number:
            assert begun.wait(timeout=60.0)
            raise KeyboardInterrupt
        begun.set()
        try:
            while True:  # the test's time limit ends it where nothing else does
                parallel_map(abs, [number])
        finally:
            ended.append(number)

    def run() -> None:
        with workers("threads") as each:
            list(each(fit, [1, 0]))

    with pytest.raises(KeyboardInterrupt):
        run()
    assert ended == [0]
    assert parallel_map(abs, [-2, 3]) == [2, 3]


@pytest.mark.parametrize("scheduler", ["threads", "processes"])
@pytest.mark.slow
def test_workers_find_the_same(loops, scheduler):
    settings = FitSettings(kind="integrated", weights="free", starts=3)
    alone = fit_model(FitRequest(loops[:4], settings))
    with workers(scheduler) as run:
        found = fit_model(FitRequest(loops[:4], settings, run=run))
    assert found.model == alone.model
    assert found.starts == alone.starts


@pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None,
    reason="Dask is not installed: pip install 'hilctl[scale]'",
)
@pytest.mark.filterwarnings("ignore")
def test_dask_cluster_finds_the_same(loops):
    from distributed import LocalCluster

    settings = FitSettings(kind="integrated", weights="free", starts=3)
    alone = fit_model(FitRequest(loops[:4], settings))
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, protocol="tcp",
            dashboard_address=None,
        ) as cluster,
        workers(cluster.scheduler_address) as run,
    ):  # fmt: skip
        found = fit_model(FitRequest(loops[:4], settings, run=run))
    assert found.model == alone.model


def test_processes_execute_nothing_of_the_working_folder(tmp_path, monkeypatch):
    """Their first imports precede the list of folders that they get."""
    (tmp_path / "socket.py").write_text("raise SystemExit(7)", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    with workers("processes") as run:
        assert list(run(math.sqrt, [4.0])) == [2.0]


def test_unknown_schedulers_are_refused():
    with pytest.raises(InputError, match=r"'four'"), workers("four"):
        pass

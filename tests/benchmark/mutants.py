"""Change a module in every small way, and see whether its tests notice.

    python -m tests.benchmark.mutants hilctl/loop/pacer.py [--jobs 2] [--json FILE]

``mutants.yaml`` says which tests judge which module, and which changes nobody can notice, and why.
"""

import argparse
import gc
import importlib
import json
import multiprocessing as mp
import os
import resource
import runpy
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from multiprocessing.connection import wait
from pathlib import Path

import grimp
import pytest
import yaml

from tests.benchmark.mutations import Mutation, mutations

ROOT = Path(__file__).parents[2]
TABLE = Path(__file__).with_suffix(".yaml")
HOOK = Path(__file__).with_name("mutant")
TOO_LONG = 99
GRACE_S = 10.0
FORK = mp.get_context("fork")


class Judge:
    """Runs tests against one mutant after another, each in a process of its own.

    Args:
        path: The module.
        tests: What pytest is called with.
        folder: For files.
    """

    def __init__(self, path: Path, tests: list[str], folder: Path) -> None:
        parts = path.relative_to("drivers") if path.parts[0] == "drivers" else path
        self._path = path
        self._name = ".".join(parts.with_suffix("").parts)
        self._tests = tests
        self._folder = folder
        os.environ["PYTHONPATH"] = f"{HOOK}:{os.environ.get('PYTHONPATH', ROOT)}"
        if self._name.startswith("hilctl.kernels."):
            os.environ["NUMBA_DISABLE_JIT"] = "1"  # its cache can't tell constants apart
        self._cpu_s = self._wall_s = 300.0

    def prepare(self) -> float:
        """Run the tests without a change; import what they need and no change reaches.

        Returns:
            How long that took, in s.

        Raises:
            SystemExit: A test fails.
        """
        began_s, used_s = time.monotonic(), _children_s()
        process = FORK.Process(target=self._run, args=(None, self._folder / "unchanged"))
        process.start()
        process.join()
        output = self._folder / "unchanged" / "output"
        if process.exitcode:
            sys.exit(f"{output.read_text()}\nthe tests fail without any change")
        took_s, used_s = time.monotonic() - began_s, _children_s() - used_s
        self._cpu_s, self._wall_s = 3.0 * used_s + 5.0, 4.0 * took_s + 10.0
        graph = grimp.build_graph("hilctl", "hilctl_drivers", cache_dir=None)
        changed = {self._name}
        if self._name in graph.modules:
            changed |= graph.find_downstream_modules(self._name)
        loaded = json.loads((self._folder / "unchanged" / "modules").read_text())
        for name in loaded:
            if name == "hypothesis" or (name in graph.modules and name not in changed):
                importlib.import_module(name)
        gc.collect()
        gc.freeze()  # else each fork would look through all of it
        return took_s

    def judge(self, mutants: list[Mutation], jobs: int) -> Iterator[tuple[Mutation, str]]:
        """Yield each mutant with its verdict: killed, survived or timed out."""
        waiting = list(enumerate(mutants))[::-1]
        running: dict[int, tuple[mp.process.BaseProcess, Mutation, float]] = {}
        while waiting or running:
            while waiting and len(running) < jobs:
                number, mutant = waiting.pop()
                process = FORK.Process(target=self._run, args=(mutant, self._folder / str(number)))
                process.start()
                running[process.sentinel] = process, mutant, time.monotonic() + self._wall_s
            ended = wait(list(running), timeout=0.5)
            for sentinel, (process, mutant, deadline_s) in list(running.items()):
                if sentinel in ended:
                    del running[sentinel]
                    process.join()
                    with suppress(ProcessLookupError):
                        os.killpg(process.pid, signal.SIGKILL)  # what it left running
                    yield mutant, _verdict(process.exitcode)
                elif time.monotonic() > deadline_s:
                    late = time.monotonic() > deadline_s + GRACE_S
                    os.kill(process.pid, signal.SIGKILL if late else signal.SIGXCPU)

    def _run(self, mutant: Mutation | None, folder: Path) -> None:
        """Run the tests in this process, which is a fork, and leave with pytest's exit code."""
        os.setsid()
        folder.mkdir()
        os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
        output = os.open(folder / "output", os.O_CREAT | os.O_WRONLY, 0o600)
        os.dup2(output, 1)
        os.dup2(output, 2)
        if mutant is not None:
            file = folder / "mutant.py"
            file.write_text(mutant.source, encoding="utf-8")
            os.environ["HILCTL_MUTANT"] = f"{ROOT / self._path}={file}"
            runpy.run_path(str(HOOK / "sitecustomize.py"))
        # Through pytest, so that fixtures still put away what they made in shared memory.
        signal.signal(signal.SIGXCPU, lambda *_: pytest.exit("too long", returncode=TOO_LONG))
        resource.setrlimit(resource.RLIMIT_CPU, (round(self._cpu_s), round(self._cpu_s + GRACE_S)))
        # Nothing is rewritten or told in full: that takes longer than most tests.
        told = "--tb=no" if mutant else "--tb=short"
        options = ("-x", "-q", "--assert=plain", told, "-p", "no:cacheprovider")
        code = pytest.main([*options, f"--basetemp={folder / 'pytest'}", *self._tests])
        if mutant is None:
            (folder / "modules").write_text(json.dumps(sorted(sys.modules)))
        sys.stdout.flush()
        os._exit(code)


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _verdict(code: int | None) -> str:
    if code == 0:
        return "survived"
    return "timed out" if code in {TOO_LONG, -signal.SIGKILL, -signal.SIGXCPU} else "killed"


def main() -> None:
    """Judge one module."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("module", type=Path, help="from the top of the repository")
    parser.add_argument("tests", nargs="*", help="for pytest, instead of those in mutants.yaml")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--lines", metavar="FIRST-LAST", help="only mutants of these")
    parser.add_argument("--again", type=Path, metavar="FILE", help="only what survived there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="for programs, and --again")
    args = parser.parse_intermixed_args()
    known = yaml.safe_load(TABLE.read_text(encoding="utf-8")).get(str(args.module), {})
    argued = {(each["line"], each["becomes"]) for each in known.get("argued", [])}
    mutants = mutations((ROOT / args.module).read_text(encoding="utf-8"))
    if args.lines:
        first, last = (int(number) for number in args.lines.split("-"))
        mutants = [mutant for mutant in mutants if first <= mutant.line <= last]
    if args.again:
        before = json.loads(args.again.read_text(encoding="utf-8"))
        left = {(each["before"], each["after"]) for each in before if each["verdict"] != "killed"}
        mutants = [mutant for mutant in mutants if mutant.change in left]
    if args.lines or args.again:
        argued &= {mutant.change for mutant in mutants}
    verdicts: dict[Mutation, str] = {}
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        judge = Judge(args.module, args.tests or known["tests"], Path(folder))
        print(f"{len(mutants)} mutants; the tests take {judge.prepare():.1f} s", flush=True)
        for mutant, verdict in judge.judge(mutants, args.jobs):
            accepted = verdict == "survived" and mutant.change in argued
            verdicts[mutant] = "argued" if accepted else verdict
            if verdicts[mutant] in {"survived", "timed out"}:
                print(f"{args.module}:{mutant.line}: {verdict}, {mutant.operator}")
                print(f"  - {mutant.before}\n  + {mutant.after}", flush=True)
    counts = Counter(verdicts.values())
    print(", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items())), end="")
    print(f", in {time.monotonic() - began_s:.0f} s")
    stale = argued - {mutant.change for mutant, verdict in verdicts.items() if verdict == "argued"}
    for before, after in sorted(stale):
        print(f"argued, but killed or not there:\n  - {before}\n  + {after}")
    if args.json is not None:
        results = [{**asdict(each), "verdict": verdict} for each, verdict in verdicts.items()]
        for result in results:
            del result["source"]
        args.json.write_text(json.dumps(results, indent=1), encoding="utf-8")
    sys.exit(bool(counts["survived"] or stale))


if __name__ == "__main__":
    main()

"""Compensated runs over every wire at its highest rate, against the same runs on the rig alone.

Run it with ``python -m tests.benchmark.wires``; see README.md beside it. Everything is emulated:
TCP on loopback, serial lines on ptys.
"""

import argparse
import json
import math
import os
import pty
import select
import socket
import subprocess
import sys
import tempfile
import time
import tty
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmark.wire_runs import (
    PRIORITY,
    WIRES,
    Wire,
    emulated,
    highest_rate_hz,
    make_real_time,
    run,
    write_experiment,
    write_profiles,
)

RIG = "device={kind: simulated_terfenol, seed: 2}"
HEAD = (
    f"{'wire':19} {'rate Hz':>8} {'sine Hz':>7} {'peak %':>6} {'alone %':>7} {'samples':>7} "
    f"{'late':>5} {'skipped':>7} {'missing':>7} {'late alone':>10} {'exch. us':>8} {'p99':>6}"
)


def is_real_time_allowed() -> bool:
    """Return whether SCHED_FIFO may be had, tried on a process that does nothing."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as idle:
        allowed = make_real_time(idle.pid)
        idle.communicate(b"\n")
    return allowed


def measure(wire: Wire, folder: Path, *, stalled: bool) -> dict[str, Any]:
    """Run one wire at its highest rate, and the same on the rig alone; return a row."""
    path = folder / "experiment.yaml"
    with emulated(wire, folder) as device:
        write_experiment(path, wire, device, 1000.0 if wire.block > 1 else 1.0, 0.0)
        rate_hz = min(wire.most_hz, math.floor(100.0 * highest_rate_hz(path)) / 100.0)
        write_experiment(path, wire, device, rate_hz, wire.seconds)
        over_wire = run(path, stalled=stalled)
    alone = run(path, RIG)
    return {
        "wire": f"{wire.name}, stalled" if stalled else wire.name,
        "rate_hz": rate_hz,
        "frequency_hz": rate_hz / wire.per_cycle,
        "peak_hysteresis_percent": over_wire["peak_hysteresis_percent"],
        "alone_percent": alone["peak_hysteresis_percent"],
        "samples": over_wire["samples"],
        "code": over_wire["code"],
        "reason": over_wire["reason"],
        "late_ticks": over_wire["late_ticks"],
        "skipped_ticks": over_wire["skipped_ticks"],
        "missing": over_wire["dropped"],
        "exchange_us": over_wire["exchange_us"],
        "late_ticks_alone": alone["late_ticks"],
        "buffered": wire.block > 1,
    }


def show(row: dict[str, Any]) -> None:
    """Print one row of the table."""
    exchange_us = row["exchange_us"] or {"p50": math.nan, "p99": math.nan}
    print(
        f"{row['wire']:19} {row['rate_hz']:8.2f} {row['frequency_hz']:7.3g} "
        f"{row['peak_hysteresis_percent'] or math.nan:6.2f} {row['alone_percent']:7.2f} "
        f"{row['samples']:7} {row['late_ticks']:5} {row['skipped_ticks']:7} {row['missing']:7} "
        f"{row['late_ticks_alone']:10} {exchange_us['p50']:8.0f} {exchange_us['p99']:6.0f}  "
        f"{row['code']}{'' if row['code'] == 'completed' else ': ' + row['reason']}",
        flush=True,
    )


def machine(seconds: float) -> dict[str, list[float]]:
    """Time a sleeper once a ms, and bytes through a pty and a socket pair, under SCHED_FIFO.

    Returns:
        Lateness of the sleeper, and the way of 20 bytes: median, 99th, 99.9th percentile, in us.
    """
    make_real_time(os.getpid())
    master, slave = pty.openpty()
    tty.setraw(slave)
    near, far = socket.socketpair()
    took_us = np.zeros((3, round(seconds * 1e3)))
    for k in range(took_us.shape[1]):
        due = time.monotonic() + 1e-3
        time.sleep(1e-3)
        took_us[0, k] = 1e6 * (time.monotonic() - due)
        took_us[1, k] = way_us(slave, master)
        took_us[2, k] = way_us(near.fileno(), far.fileno())
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    for end in (master, slave):
        os.close(end)
    near.close()
    far.close()
    found = np.percentile(took_us, (50, 99, 99.9), axis=1).T.round(1).tolist()
    return dict(zip(("sleeper", "pty", "socket"), found, strict=True))


def way_us(into: int, out_of: int) -> float:
    """Return how long 20 bytes take from one end to the other, in us."""
    before_ns, got = time.perf_counter_ns(), 0
    os.write(into, bytes(20))
    while got < 20:
        select.select([out_of], [], [])
        got += len(os.read(out_of, 100))
    return 1e-3 * (time.perf_counter_ns() - before_ns)


def good(row: dict[str, Any], points: float, skipped: float) -> bool:
    """Return whether a run is complete, little is missing, and its hysteresis is the rig's own."""
    if row["code"] != "completed" or row["missing"] > (0 if row["buffered"] else skipped):
        return False
    return abs(row["peak_hysteresis_percent"] - row["alone_percent"]) <= points


def main() -> int:
    """Run the benchmark; the exit code is 1 where a run falls short."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--wire", action="append", help="only wires whose name begins so")
    parser.add_argument("--max-points", type=float, default=1.0, help="of peak hysteresis")
    parser.add_argument(
        "--max-skipped", type=float, default=math.inf, help="samples; a FIFO may never lose one"
    )
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    how = f"loop and emulator under SCHED_FIFO, priority {PRIORITY}"
    if not is_real_time_allowed():
        how = "SCHED_FIFO is refused here: loop and emulator share the machine with all the rest"
    noise = machine(2.0)
    if not options.json:
        print(how)
        for name, (half, p99, p999) in noise.items():
            print(f"{name:8} p50 {half:.0f} us, p99 {p99:.0f} us, p99.9 {p999:.0f} us")
        print(HEAD, flush=True)
    rows = rows_of(options)
    if options.json:
        print(json.dumps({"scheduling": how, "machine_us": noise, "rows": rows}, indent=2))
    return int(not all(good(row, options.max_points, options.max_skipped) for row in rows))


def rows_of(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Run the wires that are asked for, and show each as it is done."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        write_profiles(Path(name))
        for wire in WIRES:
            if not any(map(wire.name.startswith, options.wire or [""])):
                continue
            for stalled in (False, True) if wire.block > 1 else (False,):
                rows.append(measure(wire, Path(name), stalled=stalled))
                if not options.json:
                    show(rows[-1])
    return rows


if __name__ == "__main__":
    sys.exit(main())

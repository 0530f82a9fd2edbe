"""Where runs stand, what was changed and how they stopped, in plain lines."""

from collections.abc import Sequence
from typing import Any


def print_status(found: list[dict[str, Any]]) -> None:
    """Print which runs are going on, a block of lines each."""
    if not found:
        print("no run is going on")
    for run in found:
        print(f"{run['name']}  {run['state']}")
        for name, text in _status_lines(run).items():
            print(f"  {name:10} {text}")


def _status_lines(run: dict[str, Any]) -> dict[str, str]:
    """Return what there is to say of a run, by name; little where nobody answers for it."""
    lines = {}
    if total := run.get("total_samples", 0):
        at_s, total_s = run["sample"] / run["sample_rate_hz"], total / run["sample_rate_hz"]
        lines["at"] = f"{at_s:.1f} of {total_s:.1f} s"
        lines["samples"] = (
            f"{run['recorded_samples']:,} recorded, {run['missing_samples']:,} missing"
        )
        lines["late ticks"] = f"{run['late_ticks']:,}"
        lines["reference"] = f"gain {run['gain']:g}, offset {run['offset']:g}"
        if inverse := run["inverse"]:
            lines["inverse"] = inverse
    lines["recording"] = run["recording"]
    if trouble := run.get("recording_error") or run.get("error"):
        lines["trouble"] = trouble
    return lines


def print_change(name: str, answer: dict[str, Any]) -> None:
    """Print the reference and inverse that a change leads to."""
    inverse = f", inverse {answer['inverse']}" if answer["inverse"] else ""
    values = f"gain {answer['gain']:g}, offset {answer['offset']:g}{inverse}"
    values += f", over {answer['over_s']:g} s"
    print(f"{name}: {values}")


def print_stopped(stopped: Sequence[dict[str, Any]], wait_s: float) -> None:
    """Print how each run that was requested to stop has ended, a line each."""
    if not stopped:
        print("no run is going on")
    for run in stopped:
        if run["ended"]:
            print(f"{run['name']} has ended; recording: {run['recording']}")
        else:
            why = run["error"] or "it was requested to stop"
            print(f"{run['name']} is still going after {wait_s:g} s: {why}")

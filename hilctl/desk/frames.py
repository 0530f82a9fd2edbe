"""Encode frames for a page: a JSON header and float32 values.

uint32 little endian   size of the JSON in bytes, with spaces up to a multiple of 4
JSON                   ``mode`` of the window, its ``n`` buckets, ``loop`` points of the loops
                       and ``cycle`` points per cycle
float32 little endian  t_s[n], low[signals, n], high[signals, n], input[loop], output[loop]
"""

import json
import struct
from typing import Literal, TypeAlias

import numpy as np

from hilctl.desk.scope import WINDOWS_S, Scope
from hilctl.desk.signals import SIGNALS

ScopeMode: TypeAlias = Literal["roll", "cycle"]


def nearest_window_s(wanted_s: float) -> float:
    """Return the value of :data:`hilctl.desk.scope.WINDOWS_S` with the nearest ratio."""
    return min(WINDOWS_S, key=lambda each: max(each / wanted_s, wanted_s / each))


def frame_of(scope: Scope, mode: ScopeMode, window_s: float) -> bytes:
    """Return the current frame of a page.

    Args:
        scope: The windows of a run.
        mode: ``cycle`` is triggered by the waveform's cycle; without a cycle it rolls.
        window_s: Length of a rolling window, one of :data:`hilctl.desk.scope.WINDOWS_S`.
    """
    window = scope.triggered() if mode == "cycle" else None
    shown: ScopeMode = "roll" if window is None else "cycle"
    if window is None:
        window = scope.rolling(window_s)
    loops = scope.loops()
    header = json.dumps(
        {
            "mode": shown,
            "n": window.t_s.size,
            "signals": len(SIGNALS),
            "loop": loops.shape[1],
            "cycle": scope.points_a_cycle(),
        }
    ).encode()
    header += b" " * (-len(header) % 4)
    parts = (window.t_s, window.buckets.low, window.buckets.high, loops)
    values = np.concatenate([np.ravel(part) for part in parts]).astype("<f4")
    return struct.pack("<I", len(header)) + header + values.tobytes()

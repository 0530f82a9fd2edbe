"""A frame, taken apart as the page does."""

import json
import struct

import numpy as np
import pytest

from hilctl.base.segments import Segment
from hilctl.desk.frames import frame_of, nearest_window_s
from hilctl.desk.scope import Scope
from hilctl.desk.signals import ROW, SIGNALS, Traces


@pytest.fixture
def scope():
    made = Scope(1000.0, [Segment("sine", 0, 9000, 0, 9000, 50.0)], "reference")
    values = np.tile(np.arange(600.0), (len(SIGNALS), 1))
    values[ROW["measured"]] = np.nan
    made.add(Traces(np.arange(600), values, np.zeros(600, dtype=np.uint32)))
    return made


def taken_apart(frame):
    (size,) = struct.unpack_from("<I", frame)
    header = json.loads(frame[4 : 4 + size])
    values = np.frombuffer(frame, "<f4", offset=4 + size)
    n, rows = header["n"], header["signals"] * header["n"]
    low, high = values[n : n + rows], values[n + rows : n + 2 * rows]
    loops = values[n + 2 * rows :].reshape(2, header["loop"])
    return header, values[:n], low.reshape(-1, n), high.reshape(-1, n), loops


def test_a_frame_holds_the_window_and_the_loops(scope):
    frame = frame_of(scope, "cycle", 2.0)
    header, t_s, low, high, loops = taken_apart(frame)
    assert header == {"mode": "cycle", "n": 100, "signals": 6, "loop": 300, "cycle": 50}
    assert t_s == pytest.approx(np.arange(100) / 1000.0)
    assert low[ROW["error"]].tolist() == high[ROW["error"]].tolist() == list(range(500, 600))
    assert np.isnan(low[ROW["measured"]]).all()
    assert loops[0].tolist() == list(range(300, 600))
    assert len(frame) % 4 == 0


def test_what_has_no_cycle_rolls(scope):
    header, t_s, *_ = taken_apart(frame_of(scope, "roll", 0.1))
    assert (header["mode"], t_s[-1], t_s.size) == ("roll", 0.0, 100)
    empty = Scope(1000.0, [], "reference")
    assert taken_apart(frame_of(empty, "cycle", 0.1))[0]["mode"] == "roll"


@pytest.mark.parametrize(
    ("wanted_s", "given_s"), [(2.0, 2.0), (1e9, 600.0), (1e-9, 0.02), (3, 2.0)]
)
def test_a_window_is_one_of_those_there_are(wanted_s, given_s):
    assert nearest_window_s(wanted_s) == given_s

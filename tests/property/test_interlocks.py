"""Interlocks against the rules written out in plain Python, and cut into blocks anywhere."""

import math
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hilctl.base.samples import Flag
from hilctl.kernels.interlock import InterlockFlag
from tests.fakes import RigInterlocks

RATE_HZ = 100.0
LEVELS = st.sampled_from(
    [-9.0, -5.0, -2.0, -0.5, 0.0, 0.25, 0.5, 1.0, 3.0, 3.5, 4.0, math.nan, math.inf]
)
COMMANDS = st.sampled_from([-3.0, -0.5, 0.0, 0.25, 0.5, 2.0])
STILL = st.sampled_from([0.0, 0.25])  # less than frozen_um apart
ROWS = st.one_of(
    st.lists(st.tuples(COMMANDS, LEVELS, readings, LEVELS), min_size=1, max_size=60)
    for readings in (LEVELS, STILL)
)
TIMES = st.sampled_from([0.0, 0.01, 0.03])


@st.composite
def rig_limits(draw):
    return RigInterlocks(
        stroke_um=(-5.0, 3.5),
        sensor_um=draw(st.sampled_from([(-math.inf, math.inf), (-8.0, 8.0), (-2.0, 3.0)])),
        safe=draw(COMMANDS),
        sensor_invalid_s=draw(st.sampled_from([0.01, 0.03, None])),
        frozen_s=draw(st.sampled_from([0.01, 0.03, None])),
        frozen_um=draw(st.sampled_from([0.0, 0.25])),
        frozen_travel=draw(st.sampled_from([0.25, 2.0])),
        measured_deviation_a=draw(st.sampled_from([1e-9, 0.5, None])),
        deviation_s=draw(TIMES),
        rms_current_a=draw(st.sampled_from([0.5, 2.0, None])),
        thermal_time_constant_s=draw(st.sampled_from([0.02, 1.0])),
        tracking_error_um=draw(st.sampled_from([0.5, 2.0, None])),
        tracking_s=draw(TIMES),
    )


def columns(rows):
    """Return command, reference, displacement and measured, float64[n] each."""
    return [np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)]


def judged(limits, rows, cuts=()):
    """Return the first trip and the flags, with the rows cut into blocks."""
    interlocks, given_columns = limits.made(RATE_HZ), columns(rows)
    flags = np.zeros(len(rows), dtype=np.uint32)
    bounds = sorted({0, len(rows), *(cut % (len(rows) + 1) for cut in cuts)})
    trip = None
    for start, stop in pairwise(bounds):
        part = slice(start, stop)
        found = interlocks.check(start, *[each[part] for each in given_columns], flags[part])
        trip = trip or found
    return trip, flags


class Rules:
    """The interlocks as they are described, one sample after the other."""

    def __init__(self, settings):
        self.settings = settings
        self.history = []
        self.readings = []  # the rows that have one
        self.missing = 0
        self.heat = settings.safe**2

    def judge(self, *row):
        """Return the flags of a sample, and those that end the run."""
        self.history.append(row)
        if not math.isnan(row[2]):
            self.readings.append(row)
            self.missing = 0
            found = self.of_sent(*row) | self.of_reading(row[2])
            return found, found
        self.missing += 1
        found = self.of_sent(*row)
        tolerated = self.missing <= round((self.settings.sensor_invalid_s or 0.0) * RATE_HZ)
        return found | Flag.SENSOR_INVALID, found | (not tolerated) * Flag.SENSOR_INVALID

    def of_reading(self, displacement):
        settings, found = self.settings, 0
        (low, high), (left, right) = settings.stroke_um, settings.sensor_um
        if not (low <= displacement <= high and left < displacement < right):
            found |= Flag.SENSOR_INVALID
        if self.frozen():
            found |= InterlockFlag.SENSOR_FROZEN
        tracks = settings.tracking_error_um is not None
        if tracks and self.lasts(self.readings, self.off_track, settings.tracking_s):
            found |= InterlockFlag.TRACKING_ERROR
        return found

    def of_sent(self, command, _reference, _displacement, measured):
        settings, found = self.settings, 0
        deviates = settings.measured_deviation_a is not None
        if deviates and self.lasts(self.history, self.deviates, settings.deviation_s):
            found |= InterlockFlag.DEVIATION
        load = max(command**2, measured**2 if math.isfinite(measured) else 0.0)
        share = 1.0 - math.exp(-1.0 / (settings.thermal_time_constant_s * RATE_HZ))
        self.heat += (load - self.heat) * share
        if settings.rms_current_a and self.heat > settings.rms_current_a**2:
            found |= InterlockFlag.THERMAL
        return found

    def lasts(self, rows, condition, time_s):
        """Whether a condition has held in the last of the rows and for the time before it."""
        n = round(time_s * RATE_HZ) + 1
        last = range(len(rows) - n, len(rows))
        return last.start >= 0 and all(condition(k) for k in last)

    def deviates(self, k):
        before = self.history[k - 1][0] if k else self.settings.safe
        command, _, _, measured = self.history[k]
        away = self.settings.measured_deviation_a
        return not min(before, command) - away <= measured <= max(before, command) + away

    def off_track(self, k):
        _, reference, displacement, _ = self.readings[k]
        return abs(reference - displacement) > self.settings.tracking_error_um

    def frozen(self):
        """Whether the reading has stayed the same for the time after the command had moved."""
        settings = self.settings
        if settings.frozen_s is None:
            return False
        start = 0
        for k, (_, _, reading, _) in enumerate(self.readings):
            if not abs(reading - self.readings[start][2]) <= settings.frozen_um:
                start = k
        commands = [row[0] for row in self.readings[start:]]
        for k in range(len(commands)):
            if max(commands[: k + 1]) - min(commands[: k + 1]) > settings.frozen_travel:
                return len(commands) - 1 - k >= round(settings.frozen_s * RATE_HZ)
        return False


@settings(max_examples=150)
@given(rig_limits(), ROWS)
def test_follows_the_stated_rules(limits, rows):
    trip, flags = judged(limits, rows)
    rules = Rules(limits)
    expected, trips = zip(*[map(int, rules.judge(*row)) for row in rows], strict=True)
    assert flags.tolist() == list(expected)
    tripped = np.flatnonzero(trips)
    assert (trip is None) == (tripped.size == 0)
    if trip is not None:
        assert trip.sample == tripped[0]
        assert f"at sample {trip.sample}" in trip.reason


@given(rig_limits(), ROWS, st.lists(st.integers(0, 60), max_size=6))
def test_any_cut_gives_the_same_trip(limits, rows, cuts):
    whole = judged(limits, rows)
    assert_same(whole, judged(limits, rows, cuts))
    assert_same(whole, judged(limits, rows, range(len(rows))))


def assert_same(whole, cut):
    assert whole[0] == cut[0]
    np.testing.assert_array_equal(whole[1], cut[1])


@given(rig_limits(), ROWS, st.integers(1, 10_000))
def test_any_reading_after_a_gap_is_evaluated(limits, rows, gap):
    finite = [row for row in rows if all(map(math.isfinite, row))]
    if not finite:
        return
    interlocks = limits.made(RATE_HZ)
    for k, row in enumerate(finite):
        flags = np.zeros(1, dtype=np.uint32)
        trip = interlocks.check(k * (gap + 1), *columns([row]), flags)
        assert (trip is None) == (flags[0] == 0)
        outside = not -5.0 <= row[2] <= 3.5
        assert bool(flags[0] & Flag.SENSOR_INVALID) >= outside

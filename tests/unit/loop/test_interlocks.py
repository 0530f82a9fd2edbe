"""Interlocks: each one at its limit, with its message."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.device import AuxChannel
from hilctl.base.errors import InputError
from hilctl.base.samples import BlockHeader, Flag
from hilctl.kernels.interlock import InterlockFlag
from hilctl.loop.interlocks import AuxLimit, Trip, warming
from tests.fakes import RigInterlocks, made_block

RATE_HZ = 1000.0
STROKE = RigInterlocks(stroke_um=(-60.0, 50.0), sensor_um=(-100.0, 100.0))


class Fed:
    """Interlocks with columns as input, each a number, a list, or NaN if omitted."""

    def __init__(self, limits, rate_hz=RATE_HZ):
        self.interlocks = limits.made(rate_hz)
        self.flags = np.zeros(0, dtype=np.uint32)

    def feed(self, n, *, first=0, command=0.0, reference=math.nan, displacement=1.0, measured=None):
        measured = math.nan if measured is None else measured
        given = [
            np.array(np.broadcast_to(each, n), dtype=np.float64)
            for each in (command, reference, displacement, measured)
        ]
        self.flags = np.zeros(n, dtype=np.uint32)
        return self.interlocks.check(first, *given, self.flags)

    def flagged(self, flag):
        return np.flatnonzero(self.flags & flag).tolist()


def trips(limits, n, **columns):
    """Return the trip of one block, and the flags."""
    bench = Fed(limits)
    trip = bench.feed(n, **columns)
    return trip, bench


class TestStroke:
    @pytest.mark.parametrize(
        ("value", "shown"),
        [(-60.001, "-60"), (50.001, "50"), (77.7, "77.7"), (np.inf, "inf")],
    )
    def test_outside(self, value, shown):
        trip, bench = trips(STROKE, 4, first=100, displacement=[1.0, value, 2.0, value])
        reason = f"displacement {shown} µm at sample 101 is outside the stroke limits -60 to 50 µm"
        assert trip == Trip(101, "stroke", reason)
        assert bench.flagged(Flag.SENSOR_INVALID) == [1, 3]


class TestAux:
    FREE, COIL = AuxLimit(AuxChannel("rod_c")), AuxLimit(AuxChannel("coil_c", "°C"), high=80.0)
    PRELOAD = AuxLimit(AuxChannel("preload_n", "N"), 200.0, 900.0)

    def sample_of_trip(self, values, *, limit=COIL, invalid_s=None, skipped=0):
        """Feed blocks of 10 samples; return the sample of the trip, None without one."""
        limits = replace(STROKE, aux=(self.FREE, limit), sensor_invalid_s=invalid_s)
        interlocks = limits.made(RATE_HZ)
        for number, value in enumerate(values):
            block = made_block(10, fill=0.0, aux=2)
            block.head[BlockHeader.FIRST_SAMPLE] = 10 * number
            block.skipped = skipped
            block.aux[1] = value
            if (trip := interlocks.judge(block)) is not None:
                assert trip.code == "aux"
                assert (block.flags == InterlockFlag.AUX).all()
                return trip.sample
            assert not block.flags.any()
        return None

    @pytest.mark.parametrize(
        ("limit", "values", "sample"),
        [
            (COIL, [-1e6, 80.0, 79.0], None),
            (COIL, [80.0, 80.1], 10),
            (COIL, [np.inf], 0),
            (PRELOAD, [200.0, 900.0, 199.0], 20),
            (FREE, [np.inf, np.nan], None),
        ],
    )
    def test_limits(self, limit, values, sample):
        assert self.sample_of_trip(values, limit=limit) == sample

    @pytest.mark.parametrize(
        ("missing", "options", "sample"),
        [
            (1, {}, 0),
            (3, {"invalid_s": 0.03}, None),
            (4, {"invalid_s": 0.03}, 30),
            (2, {"invalid_s": 0.03, "skipped": 10}, 10),
        ],
    )
    def test_missing_values_trip_as_invalid_readings(self, missing, options, sample):
        values = [np.nan] * missing + [20.0, np.nan] * bool(options)
        assert self.sample_of_trip(values, **options) == sample


class TestMissing:
    LIMITS = replace(STROKE, sensor_invalid_s=0.003, measured_deviation_a=0.1)

    def test_skipped_samples_count(self):
        bench = Fed(self.LIMITS)
        assert bench.feed(1, measured=0.0, displacement=np.nan) is None
        assert bench.feed(1, first=9, measured=0.0, displacement=np.nan).code == "sensor_invalid"


class TestSensorRange:
    @pytest.mark.parametrize("rail", [-100.0, 100.0, 100.5, -101.0])
    def test_at_the_end(self, rail):
        trip, bench = trips(STROKE, 3, displacement=[0.0, 0.0, rail])
        assert trip.code == "sensor_range"
        assert trip.sample == 2
        assert f"{rail:g} µm" in trip.reason
        assert bench.flagged(Flag.SENSOR_INVALID) == [2]

    def test_a_zero_shifts_the_range_and_not_the_stroke(self):
        bench = Fed(STROKE)
        bench.interlocks.zero(60.0)
        assert bench.feed(1, displacement=39.0) is None
        trip = bench.feed(1, displacement=40.0)
        assert (trip.code, "-160 to 40" in trip.reason) == ("sensor_range", True)


FROZEN = replace(STROKE, frozen_s=0.01, frozen_travel=0.5)


class TestFrozen:
    def test_condition_trips_after_its_time(self):
        command = np.concatenate((np.zeros(20), np.full(40, 0.6)))
        trip, bench = trips(FROZEN, 60, command=command, displacement=12.34567)
        assert trip == Trip(
            30,
            "sensor_frozen",
            "displacement at sample 30 is still 12.3457 µm, 0.01 s after the command had moved by "
            "0.5 A: the sensor is frozen",
        )
        assert bench.flagged(InterlockFlag.SENSOR_FROZEN) == list(range(30, 60))

    def test_travel_of_exactly_the_limit_does_not_count(self):
        still = np.zeros(50)
        assert trips(FROZEN, 100, command=np.concatenate((still, still - 0.5)))[0] is None
        assert trips(FROZEN, 100, command=np.concatenate((still, still - 0.51)))[0].sample == 60

    def test_names_the_unit(self):
        limits = replace(FROZEN, unit="V")
        trip, _ = trips(limits, 60, command=np.arange(60.0), displacement=1.0)
        assert "moved by 0.5 V" in trip.reason


DEVIATION = replace(STROKE, measured_deviation_a=0.5, deviation_s=0.003)


class TestDeviation:
    def test_condition_trips_after_its_time(self):
        measured = np.concatenate((np.full(10, 2.0), np.full(10, 2.75)))
        trip, bench = trips(DEVIATION, 20, first=0, command=2.0, measured=measured)
        assert (trip.sample, trip.code) == (13, "deviation")
        for number in ("2.75 A", "2 A", "0.5 A", "0.003 s"):
            assert number in trip.reason
        assert bench.flagged(InterlockFlag.DEVIATION) == list(range(13, 20))

    @pytest.mark.parametrize("measured", [1.49, 2.51, np.nan, np.inf, -np.inf])
    def test_beyond_without_a_time(self, measured):
        limits = replace(DEVIATION, safe=2.0, deviation_s=0.0, unit="V")
        trip, _ = trips(limits, 5, first=7, command=2.0, measured=measured)
        assert trip.sample == 7
        assert f"{measured:.4g} V" in trip.reason

    def test_starts_from_the_output_that_is_found(self):
        bench = Fed(replace(STROKE, measured_deviation_a=0.1))
        bench.interlocks.begin_at(3.0)
        assert bench.feed(1, command=2.9, measured=3.05) is None
        assert Fed(replace(STROKE, measured_deviation_a=0.1)).feed(1, command=2.9, measured=3.05)


THERMAL = replace(STROKE, rms_current_a=2.0, thermal_time_constant_s=0.1)
HEATING = [(0.0, -3.0), (-3.0, 0.0), (3.0, np.nan), (3.0, np.inf)]


class TestThermal:
    def test_trips_when_the_budget_is_used_up(self):
        """At a constant current, after tau ln(i^2 / (i^2 - rms^2))."""
        trip, bench = trips(THERMAL, 100, command=-3.0)
        expected_s = 0.1 * math.log(9.0 / (9.0 - 4.0))
        assert trip.sample == math.ceil(expected_s * RATE_HZ) - 1
        assert trip.code == "thermal"
        assert trip.reason == (
            f"thermal budget of the coil, 2 A rms over 0.1 s, was used up at sample {trip.sample}"
        )
        assert bench.flagged(InterlockFlag.THERMAL) == list(range(trip.sample, 100))

    def test_the_budget_itself_can_be_kept_for_ever(self):
        assert trips(THERMAL, 20_000, command=2.0)[0] is None
        assert trips(replace(THERMAL, safe=2.0), 20, command=2.0)[0] is None
        assert trips(THERMAL, 20_000, command=2.001)[0] is not None

    def test_starts_at_the_heat_that_the_last_run_has_left(self):
        hot = replace(THERMAL, heat_a2=3.99)
        assert trips(hot, 5, command=2.9)[0].code == "thermal"
        assert trips(THERMAL, 5, command=2.9)[0] is None

    def test_starts_at_the_heat_of_the_output_that_is_found(self):
        """An initial output of 3 A has used up a budget of 2 A."""
        assert trips(THERMAL, 5)[0] is None
        bench = Fed(THERMAL)
        bench.interlocks.begin_at(3.0)
        assert bench.feed(5).code == "thermal"


TRACKING = replace(STROKE, tracking_error_um=2.0, tracking_s=0.005)


class TestTracking:
    def test_condition_trips_after_its_time(self):
        reference = np.concatenate((np.full(10, 1.0), np.full(20, -1.5)))
        trip, bench = trips(TRACKING, 30, reference=reference, displacement=1.0)
        assert trip == Trip(
            15,
            "tracking_error",
            "tracking error -2.5 µm at sample 15 is beyond 2 µm for longer than 0.005 s",
        )
        assert bench.flagged(InterlockFlag.TRACKING_ERROR) == list(range(15, 30))

    def test_without_a_time(self):
        limits = replace(TRACKING, tracking_s=0.0)
        assert trips(limits, 9, reference=3.0, displacement=1.0)[0] is None
        assert trips(limits, 9, reference=-1.0, displacement=1.0)[0] is None
        trip, _ = trips(limits, 9, reference=3.01, displacement=1.0)
        assert trip.reason == "tracking error 2.01 µm at sample 0 is beyond 2 µm"


EVERYTHING = replace(
    STROKE,
    frozen_s=0.001,
    frozen_travel=0.5,
    measured_deviation_a=0.5,
    rms_current_a=2.0,
    thermal_time_constant_s=0.001,
    tracking_error_um=2.0,
)


class TestSeveral:
    def test_cause_before_consequence(self):
        limits = replace(EVERYTHING, frozen_s=1e-6)
        moving = {"command": 9.0, "reference": 9.0, "displacement": 1.0}
        told = []
        for change in (
            {"displacement": np.nan},
            {},
            {"displacement": 2.0},
            {"displacement": 2.0, "measured": 9.0},
            {"displacement": 2.0, "command": 0.0, "measured": 0.0},
        ):
            bench = Fed(limits)
            bench.feed(1, command=0.0, measured=0.0)
            bench.feed(1, first=1, command=0.0 if "command" in change else 9.0, measured=0.0)
            told.append(bench.feed(1, first=2, **{**moving, **change}).code)
        assert told == [
            "sensor_invalid", "sensor_frozen", "deviation", "thermal", "tracking_error",
        ]  # fmt: skip

    def test_lasting_conditions_trip_in_every_block(self):
        bench = Fed(STROKE)
        assert bench.feed(5, displacement=99.0).sample == 0
        assert bench.feed(5, first=5, displacement=99.0).sample == 5
        assert bench.feed(5, first=10, displacement=1.0) is None


class TestGaps:
    def test_time_passes_with_the_output_held(self):
        whole, gap = Fed(THERMAL), Fed(THERMAL)
        for bench in (whole, gap):
            assert bench.feed(20, command=2.5) is None
        assert whole.feed(30, first=20, command=2.5) is None
        first = whole.feed(300, first=50, command=2.5).sample
        assert first > 80
        assert gap.feed(300, first=50, command=2.5).sample == first

    def test_coil_cools_over_a_gap(self):
        bench = Fed(THERMAL)
        bench.feed(40, command=3.0)
        bench.feed(1, first=40, command=0.0)
        trip = bench.feed(100, first=2041, command=3.0)
        assert trip.sample - 2041 == trips(THERMAL, 100, command=3.0)[0].sample

    @pytest.mark.parametrize(("limits", "columns"), [
        (FROZEN, {"command": np.full(100, 9.0)}),
        (DEVIATION, {"command": np.zeros(100), "measured": np.full(100, 9.0)}),
        (TRACKING, {"reference": np.full(100, 9.0)}),
    ])  # fmt: skip
    def test_conditions_last_over_a_gap(self, limits, columns):
        bench = Fed(limits)
        bench.feed(1, command=0.0, measured=0.0)
        start = {name: values[:2] for name, values in columns.items()}
        assert bench.feed(2, first=1, **start) is None
        rest = {name: values[:9] for name, values in columns.items()}
        assert bench.feed(9, first=40, **rest).sample == 40

    @pytest.mark.parametrize("limits", [FROZEN, DEVIATION, TRACKING])
    def test_gap_alone_is_no_condition(self, limits):
        bench = Fed(limits)
        assert bench.feed(5, measured=0.0, reference=1.0) is None
        assert bench.feed(5, first=5000, measured=0.0, reference=1.0) is None
        trip = bench.feed(50, first=5005, command=9.0, measured=-9.0, reference=9.0)
        assert trip.sample == 5005 + {FROZEN: 10, DEVIATION: 3, TRACKING: 5}[limits]


class TestTimes:
    @pytest.mark.parametrize(
        ("time_s", "rate_hz", "samples"),
        [(0.0, 1e3, 0), (1e-6, 1e3, 1), (0.07, 100.0, 7), (0.0101, 1e3, 11), (0.003, 5e4, 150)],
    )
    def test_times_are_rounded_up_to_samples(self, time_s, rate_hz, samples):
        """A condition never has less than its time; 0.07 s at 100 Hz are 7 samples, not 8."""
        bench = Fed(replace(TRACKING, tracking_s=time_s), rate_hz)
        assert bench.feed(500, reference=9.0).sample == samples

    def test_warming(self):
        """The share of one sample is exact for a current that is held."""
        assert warming(0.25, 100.0) == pytest.approx(1.0 - math.exp(-0.04), rel=1e-14)
        assert warming(3600.0, 200e3) == pytest.approx(1.0 / (3600.0 * 200e3), rel=1e-8)


@pytest.mark.parametrize(("field", "value", "text"), [
    ("frozen_travel", 0.0, "frozen_travel must be > 0: 0.0"),
    ("stroke_um", (1.0, 1.0), "stroke_um must be lowest and highest: 1.0, 1.0"),
    ("sensor_um", (2.0, 1.0), "sensor_um must be lowest and highest: 2.0, 1.0"),
])  # fmt: skip
def test_invalid_rig_is_refused(field, value, text):
    with pytest.raises(InputError) as caught:
        replace(STROKE, **{field: value}).made(RATE_HZ)
    assert str(caught.value) == text

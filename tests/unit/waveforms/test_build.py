"""Soft starts and ends, sequences, and what of a waveform is judged."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilctl.base import types
from hilctl.base.errors import InputError
from hilctl.base.segments import Segment
from hilctl.base.types import chunks
from hilctl.waveforms import build as module
from hilctl.waveforms import shapes
from hilctl.waveforms.build import Reference, RepeatedPart, build
from hilctl.waveforms.spec import Hold

Made = Callable[..., Reference]
SINE: dict[str, Any] = {"kind": "sine", "amplitude": 6.0, "frequency_hz": 10.0}


def raised_cosine(x: float) -> float:
    return float(np.sin(0.5 * np.pi * x) ** 2)


class TestSoft:
    def test_envelope(self, made: Made) -> None:
        hard = made(1000.0, **SINE, offset=3.0, duration_s=1.0).values
        soft = made(1000.0, **SINE, offset=3.0, duration_s=1.0, soft_start_s=0.2, soft_end_s=0.3)
        values = soft.values
        assert values[0] == 0.0
        assert values[-1] == 0.0
        np.testing.assert_array_equal(values[200:700], hard[200:700])
        grow = np.array([raised_cosine(k / 200) for k in range(200)])
        shrink = np.array([raised_cosine(k / 300) for k in range(300)])[::-1]
        np.testing.assert_allclose(values[:200], grow * hard[:200], rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(values[700:], shrink * hard[700:], rtol=0.0, atol=1e-12)

    def test_from_and_to_where_the_actuator_rests(self, made: Made) -> None:
        keys = {**SINE, "offset": 40.0, "duration_s": 1.0}
        hard = made(1000.0, **keys).values
        soft = made(1000.0, **keys, rest=50.0, soft_start_s=0.2, soft_end_s=0.3).values
        assert soft[0] == soft[-1] == 50.0
        np.testing.assert_array_equal(soft[200:700], hard[200:700])
        grow = np.array([raised_cosine(k / 200) for k in range(200)])
        np.testing.assert_allclose(soft[:200], 50.0 + grow * (hard[:200] - 50.0), atol=1e-12)

    def test_offset_is_softened_too(self, made: Made) -> None:
        keys = {"kind": "hold", "level": 2.0, "offset": -7.0, "duration_s": 1.0}
        values = made(1000.0, **keys, soft_start_s=0.5, soft_end_s=0.5).values
        assert values[0] == 0.0
        assert values[-1] == 0.0
        assert values[500] == pytest.approx(-5.0, abs=1e-4)
        assert values.min() >= -5.0
        assert np.max(np.abs(np.diff(values))) < 5.0 * np.pi / 2.0 / 500.0 * 1.001
        assert np.all(np.diff(values[:500]) < 0.0)
        assert np.all(np.diff(values[500:]) > 0.0)

    def test_segment_leaves_soft_parts_out(self, made: Made) -> None:
        reference = made(1000.0, **SINE, duration_s=1.0, soft_start_s=0.2, soft_end_s=0.3)
        assert reference.segments == (Segment("sine 6 A 10 Hz", 0, 1000, 200, 700, 100.0),)

    def test_halves_of_an_odd_number_of_samples(self, made: Made) -> None:
        keys = {"soft_start_s": 0.5, "soft_end_s": 0.5}
        reference = made(1003.0, **SINE, duration_s=1.0, **keys)
        segment = reference.segments[0]
        assert segment.stop == 1003
        assert 501 <= segment.steady_start <= segment.steady_stop <= 502
        assert reference.values[0] == 0.0
        assert reference.values[-1] == 0.0

    def test_decimal_times(self, made: Made) -> None:
        """A soft start of 0.29 s at 100 Hz is 29 samples, whatever binary fractions make of it."""
        reference = made(100.0, **SINE, duration_s=1.0, soft_start_s=0.29)
        assert reference.segments[0].steady_start == 29


class TestSequence:
    PARTS: tuple[dict[str, Any], ...] = (
        {**SINE, "duration_s": 0.5, "soft_start_s": 0.1},
        {"kind": "hold", "level": 2.0, "duration_s": 0.2},
        {"kind": "triangle", "amplitude": 1.0, "frequency_hz": 20.0, "duration_s": 0.3},
    )

    def test_is_its_parts_one_after_the_other(self, made: Made) -> None:
        alone = np.concatenate([made(1000.0, **part).values for part in self.PARTS])
        once = made(1000.0, kind="sequence", parts=self.PARTS)
        thrice = made(1000.0, kind="sequence", parts=self.PARTS, repeat=3)
        np.testing.assert_array_equal(once.values, alone)
        np.testing.assert_array_equal(thrice.values, np.tile(alone, 3))

    def test_segments_stand_where_their_parts_do(self, made: Made) -> None:
        reference = made(1000.0, kind="sequence", unit="A", parts=self.PARTS, repeat=2)
        one = (
            Segment("sine 6 A 10 Hz", 0, 500, 100, 500, 100.0),
            Segment("hold 2 A", 500, 700, 500, 700, 0.0),
            Segment("triangle 1 A 20 Hz", 700, 1000, 700, 1000, 50.0),
        )
        assert reference.segments == one + tuple(each.shifted(1000) for each in one)

    def test_time_starts_anew_in_each_part(self, made: Made) -> None:
        part = {**SINE, "duration_s": 0.13}
        values = made(1000.0, kind="sequence", parts=(part, part)).values
        np.testing.assert_array_equal(values[130:], values[:130])
        assert values[130] == 0.0


LABELS: list[tuple[dict[str, Any], str, float]] = [
    ({**SINE, "duration_s": 1.0}, "sine 6 A 10 Hz", 100.0),
    ({**SINE, "kind": "triangle", "duration_s": 1.0}, "triangle 6 A 10 Hz", 100.0),
    ({**SINE, "frequency_hz": 3.0, "duration_s": 1.0}, "sine 6 A 3 Hz", 1000.0 / 3.0),
    ({**SINE, "kind": "growing", "duration_s": 1.0}, "growing 6 A 10 Hz", 0.0),
    ({**SINE, "kind": "decaying", "duration_s": 1.0}, "decaying 6 A 10 Hz", 0.0),
    ({"kind": "complex_harmonic", "duration_s": 1.0, "components": (
        {"amplitude": 4.0, "frequency_hz": 2.5}, {"amplitude": 3.0, "frequency_hz": 7.5})},
     "complex harmonic 4 A 2.5 Hz + 3 A 7.5 Hz", 400.0),
    ({"kind": "chirp", "amplitude": 2.0, "start_hz": 1.0, "stop_hz": 50.0, "duration_s": 1.0},
     "chirp 2 A 1-50 Hz", 0.0),
    ({"kind": "step", "levels": (1.0, 2.0), "dwell_s": 0.5}, "step", 0.0),
    ({"kind": "hold", "level": -2.5, "duration_s": 1.0}, "hold -2.5 A", 0.0),
    ({"kind": "multisine", "amplitude": 3.0, "first_hz": 15.0, "last_hz": 45.0, "step_hz": 10.0,
      "duration_s": 1.0}, "multisine 3 A 15-45 Hz", 200.0),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "label", "period"), LABELS, ids=[case[1] for case in LABELS])
def test_label_and_period(made: Made, keys: dict[str, Any], label: str, period: float) -> None:
    reference = made(1000.0, **keys)
    segment = reference.segments[0]
    assert segment.label == label
    assert (segment.start, segment.stop) == (0, 1000)
    assert (segment.steady_start, segment.steady_stop) == (0, 1000)
    assert segment.period == pytest.approx(period, rel=1e-15)
    if period and period == round(period):
        values = reference.values
        whole = round(period)
        np.testing.assert_allclose(values[whole:], values[:-whole], rtol=0.0, atol=1e-9)


def test_period_too_long_to_count_is_none(made: Made) -> None:
    reference = made(1000.0, kind="sine", amplitude=1.0, frequency_hz=1e-320, duration_s=0.1)
    assert reference.segments[0].period == 0.0
    assert reference.segments[0].steady_cycles() == (0, 100, 0)


SAME: dict[str, Any] = {"amplitude": 1.0, "duration_s": 1.0}
NYQUIST = "{}: every frequency must be below half the sample rate, 500 Hz: {} Hz"
SOFT_S = "{}: soft_start_s + soft_end_s = {} s must fit in its {} s"
LENGTH = (
    "has {} samples, more than the 100000000 that fit in memory: shorten it, or lower "
    "sample_rate_hz"
)
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"kind": "sine", "frequency_hz": 500.5, **SAME}, NYQUIST.format("sine", "500.5")),
    ({"kind": "triangle", "frequency_hz": 500.0, **SAME}, NYQUIST.format("triangle", "500")),
    ({"kind": "chirp", "start_hz": 1.0, "stop_hz": 600.0, **SAME}, NYQUIST.format("chirp", "600")),
    ({"kind": "chirp", "start_hz": 600.0, "stop_hz": 1.0, **SAME}, NYQUIST.format("chirp", "600")),
    ({"kind": "multisine", "first_hz": 1.0, "last_hz": 501.0, "step_hz": 1.0, **SAME},
     NYQUIST.format("multisine", "501")),
    ({"kind": "complex_harmonic", "duration_s": 1.0, "components": (
        {"amplitude": 1.0, "frequency_hz": 10.0}, {"amplitude": 1.0, "frequency_hz": 700.0})},
     NYQUIST.format("complex_harmonic", "700")),
    ({**SINE, "duration_s": 1.0, "soft_start_s": 0.7, "soft_end_s": 0.4},
     SOFT_S.format("sine", "1.1", "1")),
    ({**SINE, "duration_s": 1.0, "soft_start_s": 0.501, "soft_end_s": 0.5},
     SOFT_S.format("sine", "1.001", "1")),
    ({**SINE, "duration_s": 1.0, "soft_start_s": 1e308, "soft_end_s": 1e308},
     SOFT_S.format("sine", "inf", "1")),
    ({"kind": "step", "levels": (1.0,) * 5, "dwell_s": 0.1, "soft_end_s": 0.6},
     SOFT_S.format("step", "0.6", "0.5")),
    ({"kind": "random", "amplitude": 1.0, "first_hz": 1, "last_hz": 2, "duration_s": 100_001.0},
     LENGTH.format("100001000")),
    ({**SINE, "duration_s": 1e308}, LENGTH.format("inf")),
    ({**SINE, "amplitude": 1.7e308, "offset": 1.7e308, "duration_s": 1.0, "soft_start_s": 0.1},
     "amplitude, offset or scale is too large: a value is not finite"),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "text"), REFUSED)
def test_refused(made: Made, keys: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError) as caught:
        made(1000.0, **keys)
    assert str(caught.value) == text


class TestSequenceRefused:
    def test_the_part_is_named(self, made: Made) -> None:
        parts = ({**SINE, "duration_s": 1.0}, {**SINE, "frequency_hz": 900.0, "duration_s": 1.0})
        with pytest.raises(InputError, match=r"^parts\.1 \(sine\): every frequency .*: 900 Hz$"):
            made(1000.0, kind="sequence", parts=parts)

    def test_length_counts_repeats_before_anything_is_repeated(
        self, made: Made, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(shapes, "MAX_SAMPLES", 6000)
        parts = ({**SINE, "duration_s": 1.0},) * 2
        assert made(1000.0, kind="sequence", parts=parts, repeat=3).values.size == 6000
        with pytest.raises(InputError, match="8000 samples"):
            made(1000.0, kind="sequence", parts=parts, repeat=4)
        with pytest.raises(InputError, match="has 10000000 samples"):
            made(1000.0, kind="sequence", parts=parts, repeat=10_000)


def test_unit_is_needed() -> None:
    with pytest.raises(InputError, match="unit is required"):
        build(Hold(kind="hold", level=1.0, duration_s=1.0), 1000.0, Path())


SOFT = {"soft_start_s": 0.31, "soft_end_s": 0.17, "rest": -0.5, "offset": 0.25}
WAVES: list[dict[str, Any]] = [
    {"kind": "sine", "amplitude": 6.0, "frequency_hz": 7.3, "duration_s": 4.0},
    {"kind": "triangle", "amplitude": 6.0, "frequency_hz": 7.3, "duration_s": 4.0},
    {"kind": "complex_harmonic", "components": ({"amplitude": 1.0, "frequency_hz": 3.0},
     {"amplitude": 2.0, "frequency_hz": 4.0, "phase_deg": 20.0}, ), "duration_s": 4.0},
    {"kind": "growing", "amplitude": 6.0, "frequency_hz": 7.3, "duration_s": 4.0},
    {"kind": "chirp", "amplitude": 6.0, "start_hz": 1.0, "stop_hz": 90.0, "duration_s": 4.0},
    {"kind": "step", "levels": (1.0, -2.0, 3.0), "dwell_s": 1.3, "rise_s": 0.1},
    {"kind": "hold", "level": 2.0, "duration_s": 4.0},
    {"kind": "path", "levels": (5.0, -2.0, 3.0), "rate_per_s": 4.0},
    {"kind": "random", "amplitude": 6.0, "first_hz": 2, "last_hz": 90, "duration_s": 4.0},
    {"kind": "multisine", "amplitude": 6.0, "first_hz": 5.0, "last_hz": 90.0, "step_hz": 5.0,
     "duration_s": 4.0},
]  # fmt: skip


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let everything be long, and little be processed together."""
    monkeypatch.setattr(shapes, "LONG", 1000)
    for each in (types, module, shapes):
        monkeypatch.setattr(each, "CHUNK", 97)


def waveforms() -> list[dict[str, Any]]:
    sequence = {"kind": "sequence", "parts": tuple({**w, **SOFT} for w in WAVES[:-1]), "repeat": 3}
    return [*({**w, **SOFT} for w in WAVES), sequence]


@pytest.mark.parametrize("keys", waveforms(), ids=lambda keys: keys["kind"])
def test_the_same_samples_however_long(
    made: Made, keys: dict[str, Any], request: pytest.FixtureRequest
) -> None:
    """To the last bit, in whatever chunks they are computed; and the same segments and span.

    A multisine's peak is that of its first cycles: as good as that of all, and not the same bits.
    """
    whole = made(1000.0, **keys)
    request.getfixturevalue("small")
    long = made(1000.0, **keys)
    assert (long.values.size, long.segments) == (whole.values.size, whole.segments)
    bound = 1e-12 if keys["kind"] == "multisine" else 0.0
    np.testing.assert_allclose(long.values, whole.values, rtol=bound, atol=bound)
    assert long.span == pytest.approx(whole.span, rel=5e-3)


def test_what_repeats_is_told_by_some_of_it(made: Made, small: None) -> None:
    long = made(1000.0, **WAVES[0] | {"duration_s": 1000.0}, **SOFT)
    told = np.concatenate([*chunks(long.values, long.telling)])
    assert told.size < 5000 < long.values.size
    everything = long.values
    assert told[:310].tolist() == everything[:310].tolist()
    assert told[-170:].tolist() == everything[-170:].tolist()
    assert long.span == pytest.approx((everything.min(), everything.max()), rel=1e-3)


def test_a_repeated_sequence_is_told_by_one_of_it(made: Made, small: None) -> None:
    sequence = waveforms()[-1] | {"repeat": 50}
    long = made(1000.0, **sequence)
    first = long.telling[0]
    once = long.values.size // 50
    assert (first.start, first.stop) == (0, once + 97)
    assert long.repeats == (RepeatedPart(0, long.values.size, float(once)),)


def test_what_does_not_repeat_is_told_by_all_of_it(made: Made, small: None) -> None:
    chirp = made(1000.0, **WAVES[4])
    assert chirp.telling == (slice(0, 4000),)


def test_a_value_that_is_none_is_refused_wherever_it_is(made: Made, small: None) -> None:
    keys = {"kind": "growing", "amplitude": 1.7e308, "offset": 1.7e308, "frequency_hz": 0.3}
    with pytest.raises(InputError, match="too large"):
        made(1000.0, **keys, duration_s=40.0)

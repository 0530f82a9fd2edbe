"""What holds for every waveform, whatever its numbers."""

from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter

from hilctl.base.segments import Segment
from hilctl.loop.triggers import marks_of
from hilctl.waveforms.build import Reference, build
from hilctl.waveforms.spec import AnyWaveform

RATE_HZ = 1000.0
Keys = dict[str, Any]
ADAPTER: TypeAdapter[Any] = TypeAdapter(AnyWaveform)

amplitudes = st.floats(1e-6, 1e6)
levels = st.floats(-1e6, 1e6)
frequencies_hz = st.floats(1e-3, 499.0)
durations_s = st.floats(1e-4, 2.0)


def keys(kind: str, **own: st.SearchStrategy[Any]) -> st.SearchStrategy[Keys]:
    return st.fixed_dictionaries(
        {"kind": st.just(kind), "offset": st.one_of(st.just(0.0), levels), **own}
    )


phases_deg = st.floats(-360.0, 360.0)


def sine_like(kind: str, **own: st.SearchStrategy[Any]) -> st.SearchStrategy[Keys]:
    own |= {"amplitude": amplitudes, "frequency_hz": frequencies_hz, "phase_deg": phases_deg}
    return keys(kind, duration_s=durations_s, **own)


harmonics = st.lists(
    st.fixed_dictionaries(
        {"amplitude": amplitudes, "frequency_hz": frequencies_hz, "phase_deg": phases_deg}
    ),
    min_size=1,
    max_size=5,
).map(tuple)


@st.composite
def steps(draw: st.DrawFn) -> Keys:
    """Levels with a rise that fits their dwell."""
    dwell_s = draw(st.floats(1e-3, 0.3))
    return {
        "kind": "step",
        "offset": draw(levels),
        "levels": tuple(draw(st.lists(levels, min_size=1, max_size=6))),
        "dwell_s": dwell_s,
        "rise_s": dwell_s * draw(st.sampled_from([0.0, 0.3, 1.0])),
    }


@st.composite
def multisines(draw: st.DrawFn) -> Keys:
    """A band of at most about 40 sines."""
    first_hz = draw(st.floats(0.5, 100.0))
    step_hz = draw(st.floats(0.5, 10.0))
    return {
        "kind": "multisine",
        "offset": draw(levels),
        "amplitude": draw(amplitudes),
        "first_hz": first_hz,
        "last_hz": first_hz + step_hz * draw(st.floats(0.0, 39.0)),
        "step_hz": step_hz,
        "duration_s": draw(durations_s),
    }


@st.composite
def softened(draw: st.DrawFn, waveforms: st.SearchStrategy[Keys]) -> Keys:
    """A waveform with a soft start and end that fit."""
    w = draw(waveforms)
    seconds = duration_s(w)
    start = draw(st.sampled_from([0.0, 0.1, 0.5]))
    end = draw(st.sampled_from([0.0, 0.2, 0.5]))
    return {**w, "soft_start_s": start * seconds, "soft_end_s": end * seconds}


singles = softened(
    st.one_of(
        sine_like("sine"),
        sine_like("triangle", rise=st.floats(0.01, 0.99)),
        sine_like("growing"),
        sine_like("decaying"),
        keys("complex_harmonic", components=harmonics, duration_s=durations_s),
        keys(
            "chirp",
            amplitude=amplitudes,
            start_hz=frequencies_hz,
            stop_hz=frequencies_hz,
            spacing=st.sampled_from(["linear", "logarithmic"]),
            duration_s=durations_s,
        ),
        keys("hold", level=levels, duration_s=durations_s),
        keys(
            "random",
            amplitude=amplitudes,
            first_hz=st.floats(1e-3, 100.0),
            last_hz=st.floats(200.0, 499.0),
            seed=st.integers(0, 10),
            duration_s=st.floats(0.01, 2.0),
        ),
        steps(),
        multisines(),
    )
)


def duration_s(w: Keys) -> float:
    seconds = w["dwell_s"] * len(w["levels"]) if w["kind"] == "step" else w["duration_s"]
    return float(seconds)


def bound(w: Keys) -> float:
    """Return what no sample's magnitude may exceed: |offset| and the amplitude on top."""
    if w["kind"] == "complex_harmonic":
        amplitude = sum(part["amplitude"] for part in w["components"])
    elif w["kind"] == "step":
        amplitude = max(abs(level) for level in w["levels"])
    elif w["kind"] == "hold":
        amplitude = abs(w["level"])
    else:
        amplitude = w["amplitude"]
    return float(abs(w["offset"]) + amplitude)


def made(w: Keys) -> Reference:
    return build(ADAPTER.validate_python({"unit": "um", **w}), RATE_HZ, Path())


def check_segments(segments: tuple[Segment, ...], samples: int) -> None:
    edges = [0, *(each.stop for each in segments)]
    assert [each.start for each in segments] == edges[:-1]
    assert edges[-1] == samples
    for each in segments:
        assert each.start <= each.steady_start <= each.steady_stop <= each.stop
        start, stop, cycles = each.steady_cycles()
        assert each.steady_start <= start <= stop == each.steady_stop
        assert cycles >= 0
        assert cycles == 0 or abs(stop - start - cycles * each.period) <= 1.0


@given(singles)
@settings(deadline=None)
def test_finite_bounded_and_of_the_right_length(w):
    reference = made(w)
    values = reference.values
    assert np.isfinite(values).all()
    assert np.max(np.abs(values)) <= bound(w) * (1.0 + 1e-9)
    assert values.size == max(1, round(duration_s(w) * RATE_HZ))
    check_segments(reference.segments, values.size)


@given(singles)
@settings(deadline=None)
def test_deterministic(w):
    assert made(w).values.tobytes() == made(w).values.tobytes()


@given(singles)
@settings(deadline=None)
def test_soft_ends_are_zero(w):
    """Where there is room for a soft start or end, the waveform begins or ends at 0."""
    reference = made(w)
    segment = reference.segments[0]
    if segment.steady_start > 0:
        assert reference.values[0] == 0.0
    if segment.steady_stop < segment.stop:
        assert reference.values[-1] == 0.0
    hard = made({**w, "soft_start_s": 0.0, "soft_end_s": 0.0}).values
    steady = slice(segment.steady_start, segment.steady_stop)
    np.testing.assert_array_equal(reference.values[steady], hard[steady])


@given(st.lists(sine_like("sine"), min_size=1, max_size=3), st.floats(1000.0, 5000.0))
def test_marks_of_cycles_are_less_than_a_sample_late(parts, rate_hz):
    sequence = {"kind": "sequence", "unit": "um", "parts": tuple(parts)}
    segments = build(ADAPTER.validate_python(sequence), rate_hz, Path()).segments
    marks = marks_of("cycle", segments)
    for part, each in zip(parts, segments, strict=True):
        own = marks[(each.start <= marks) & (marks < each.stop)]
        period = rate_hz / part["frequency_hz"]
        late = own - each.start - period * np.arange(own.size)
        assert -1e-5 < late.min() <= late.max() < 1.0
        assert each.start + own.size * period > each.stop - 1  # none is missing
    assert marks.max() < segments[-1].stop


@given(st.lists(singles, min_size=1, max_size=4), st.integers(1, 3))
@settings(deadline=None, max_examples=50)
def test_sequence_is_its_parts(parts, repeat):
    reference = made({"kind": "sequence", "parts": tuple(parts), "repeat": repeat})
    alone = np.concatenate([made(part).values for part in parts] * repeat)
    np.testing.assert_array_equal(reference.values, alone)
    assert len(reference.segments) == repeat * len(parts)
    check_segments(reference.segments, alone.size)

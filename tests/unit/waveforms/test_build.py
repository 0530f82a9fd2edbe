"""Soft starts and ends, sequences, and what of a waveform is judged."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilctl.base import types
from hilctl.base.errors import InputError
from hilctl.base.samples import COLUMNS, BlockBatch, BlockHeader
from hilctl.base.segments import Segment
from hilctl.base.types import F64, chunks
from hilctl.waveforms import build as module
from hilctl.waveforms import shapes
from hilctl.waveforms.build import Reference, RepeatedPart, build
from hilctl.waveforms.spec import Hold
from tests.unit.experiment.test_device_state import write_recording

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

    def test_soft_start_and_end_at_the_rest_position(self, made: Made) -> None:
        keys = {**SINE, "offset": 40.0, "duration_s": 1.0}
        hard = made(1000.0, **keys).values
        soft = made(1000.0, **keys, rest=50.0, soft_start_s=0.2, soft_end_s=0.3).values
        assert soft[0] == soft[-1] == 50.0
        np.testing.assert_array_equal(soft[200:700], hard[200:700])
        grow = np.array([raised_cosine(k / 200) for k in range(200)])
        np.testing.assert_allclose(soft[:200], 50.0 + grow * (hard[:200] - 50.0), atol=1e-12)

    def test_steady_part_excludes_soft_start_and_end(self, made: Made) -> None:
        reference = made(1000.0, **SINE, duration_s=1.0, soft_start_s=0.2, soft_end_s=0.3)
        assert reference.segments == (Segment("sine 6 A 10 Hz", 0, 1000, 200, 700, 100.0),)

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

    def test_segments_are_at_their_parts(self, made: Made) -> None:
        reference = made(1000.0, kind="sequence", unit="A", parts=self.PARTS, repeat=2)
        one = (
            Segment("sine 6 A 10 Hz", 0, 500, 100, 500, 100.0),
            Segment("hold 2 A", 500, 700, 500, 700, 0.0),
            Segment("triangle 1 A 20 Hz", 700, 1000, 700, 1000, 50.0),
        )
        assert reference.segments == one + tuple(each.shifted(1000) for each in one)


LABELS: list[tuple[dict[str, Any], str, float]] = [
    ({**SINE, "duration_s": 1.0}, "sine 6 A 10 Hz", 100.0),
    ({**SINE, "kind": "triangle", "duration_s": 1.0}, "triangle 6 A 10 Hz", 100.0),
    ({**SINE, "kind": "triangle", "rise": 0.9, "phase_deg": 162.0, "duration_s": 1.0},
     "triangle 6 A 10 Hz", 100.0),
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
        with pytest.raises(InputError, match=r"^parts\.1 .*: 900 Hz$"):
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
    with pytest.raises(InputError, match="unit"):
        build(Hold(kind="hold", level=1.0, duration_s=1.0), 1000.0, Path())


SOFT = {"soft_start_s": 0.31, "soft_end_s": 0.17, "rest": -0.5, "offset": 0.25}
WAVES: list[dict[str, Any]] = [
    {"kind": "sine", "amplitude": 6.0, "frequency_hz": 7.3, "duration_s": 4.0},
    {"kind": "triangle", "amplitude": 6.0, "frequency_hz": 7.3, "rise": 0.8, "duration_s": 4.0},
    {"kind": "complex_harmonic", "components": ({"amplitude": 1.0, "frequency_hz": 3.0},
     {"amplitude": 2.0, "frequency_hz": 4.0, "phase_deg": 20.0}, ), "duration_s": 4.0},
    {"kind": "growing", "amplitude": 6.0, "frequency_hz": 7.3, "phase_deg": 90.0,
     "duration_s": 4.0},
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


def test_periodic_waveform_is_checked_in_part(made: Made, small: None) -> None:
    long = made(1000.0, **WAVES[0] | {"duration_s": 1000.0}, **SOFT)
    told = np.concatenate([*chunks(long.values, long.telling)])
    assert told.size < 5000 < long.values.size
    everything = long.values
    assert told[:310].tolist() == everything[:310].tolist()
    assert told[-170:].tolist() == everything[-170:].tolist()
    assert long.span == pytest.approx((everything.min(), everything.max()), rel=1e-3)


def test_repeated_sequence_is_checked_once(made: Made, small: None) -> None:
    sequence = waveforms()[-1] | {"repeat": 50}
    long = made(1000.0, **sequence)
    first = long.telling[0]
    once = long.values.size // 50
    assert (first.start, first.stop) == (0, once + 97)
    assert long.repeats == (RepeatedPart(0, long.values.size, float(once)),)


def test_nonperiodic_waveform_is_checked_completely(made: Made, small: None) -> None:
    chirp = made(1000.0, **WAVES[4])
    assert chirp.telling == (slice(0, 4000),)


def test_nonfinite_value_is_refused_anywhere(made: Made, small: None) -> None:
    keys = {"kind": "growing", "amplitude": 1.7e308, "offset": 1.7e308, "frequency_hz": 0.3}
    with pytest.raises(InputError, match="too large"):
        made(1000.0, **keys, duration_s=40.0)


RATE_HZ = 1000.0
WAVE = np.round(3.0 * np.sin(2.0 * np.pi * 10.0 * np.arange(200) / RATE_HZ), 6)
T_S = np.arange(200) / RATE_HZ
Read = Callable[..., Reference]


@pytest.fixture
def read(made: Made, tmp_path: Path) -> Read:
    """Write bytes or text to a file and build the waveform that reads it."""

    def write_and_read(content: str | bytes, name: str = "w.csv", **keys: Any) -> Reference:
        raw = content.encode() if isinstance(content, str) else content
        (tmp_path / name).write_bytes(raw)
        return made(RATE_HZ, tmp_path, kind="file", path=name, **{"unit": "um"} | keys)

    return write_and_read


def refusal(read: Read, content: str | bytes, name: str = "w.csv", **keys: Any) -> str:
    """Return the message without the folder in front."""
    with pytest.raises(InputError) as caught:
        read(content, name, **keys)
    place, found, text = str(caught.value).partition(f"/{name}:")
    assert found, caught.value
    assert Path(place).is_absolute()
    return text.removeprefix(" ")


def rows(*columns: Any, delimiter: str = ",") -> str:
    return "".join(
        delimiter.join(repr(float(v)) for v in row) + "\n" for row in zip(*columns, strict=True)
    )


@pytest.mark.parametrize("suffix", [".csv", ".npy", ".mcap"])
def test_impossible_file_name_is_refused(made: Made, tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match="name too long"):
        made(RATE_HZ, tmp_path, kind="file", path="x" * 300 + suffix, file_rate_hz=RATE_HZ)


def test_period_shorter_than_a_sample(read: Read) -> None:
    text = refusal(read, "1\n2\n", period_s=1e-9, file_rate_hz=RATE_HZ)
    assert text.startswith("period_s must be")


class TestText:
    def test_scale_offset_and_softness(self, read: Read) -> None:
        text = rows(WAVE)
        plain = read(text, file_rate_hz=RATE_HZ, scale=-2.0, offset=5.0)
        np.testing.assert_array_equal(plain.values, 5.0 - 2.0 * WAVE)
        soft = read(text, file_rate_hz=RATE_HZ, offset=5.0, soft_start_s=0.05, soft_end_s=0.05)
        assert soft.values[0] == 0.0
        assert soft.values[-1] == 0.0
        np.testing.assert_array_equal(soft.values[50:150], 5.0 + WAVE[50:150])
        assert (soft.segments[0].steady_start, soft.segments[0].steady_stop) == (50, 150)

    def test_axes_from_columns_of_one_file(self, read: Read) -> None:
        """The columns have the same start and length, also at another rate."""
        text = "t_s,x,y\n" + rows(T_S * 0.7, WAVE, -WAVE)
        for resample in ("linear", "cubic"):
            x, y = (read(text, column=name, resample=resample, soft_start_s=0.01) for name in "xy")
            np.testing.assert_allclose(y.values, -x.values, rtol=0.0, atol=1e-12)
            assert (x.values.size, x.segments) == (140, y.segments)
        ragged = text.rsplit(",", 1)[0] + ",\n"
        assert read(ragged, column="x", resample="linear").values.size == 140
        assert "must be a finite number" in refusal(read, ragged, column="y", resample="linear")

    def test_period_makes_steady_cycles(self, read: Read) -> None:
        segment = read(rows(WAVE), file_rate_hz=RATE_HZ, period_s=0.1).segments[0]
        assert segment.period == pytest.approx(100.0)
        assert segment.steady_cycles() == (100, 200, 1)


class TestTextRefused:
    def test_value_that_overflows(self, read: Read) -> None:
        text = rows(WAVE)
        for soft_s in (0.0, 0.1):
            with pytest.raises(InputError, match="too large"):
                read(text, file_rate_hz=RATE_HZ, scale=1e308, offset=-1e308, soft_end_s=soft_s)

    def test_one_row(self, read: Read) -> None:
        text = refusal(read, rows(WAVE), file_rate_hz=1e3, first_row=200)
        assert "two rows" in text

    def test_missing_rows(self, read: Read) -> None:
        """A reference is not interpolated unless asked for."""
        text = refusal(
            read, "t_s,x\n" + rows(np.delete(T_S, 150), np.delete(WAVE, 150)), column="x"
        )
        assert text.startswith("152: samples must be evenly spaced")

    def test_invalid_row_and_the_key_that_omits_it(self, read: Read) -> None:
        content = rows(WAVE[:150]) + "OL\n" + rows(WAVE[151:])
        text = refusal(read, content, file_rate_hz=RATE_HZ)
        assert text.startswith("151: column 1")
        assert text.endswith("last_row=150")
        assert read(content, file_rate_hz=RATE_HZ, last_row=150).values.size == 150


class TestRate:
    def test_contradiction(self, read: Read) -> None:
        text = refusal(read, "t_s,x\n" + rows(T_S, WAVE), column="x", file_rate_hz=999.0)
        assert "file_rate_hz is 999 Hz" in text
        assert read("t_s,x\n" + rows(T_S, WAVE), column="x", file_rate_hz=1000).values.size == 200

    def test_mismatch_is_refused(self, read: Read) -> None:
        text = refusal(read, rows(WAVE), file_rate_hz=500.0)
        assert "500 Hz" in text
        assert "resample" in text
        nearly = refusal(read, rows(WAVE), file_rate_hz=1000.01)
        assert "1000.01 Hz" in nearly

    @pytest.mark.parametrize("file_rate_hz", [250.0, 400.0, 2500.0])
    def test_linear(self, read: Read, file_rate_hz: float) -> None:
        corners = np.array([0.0, 2.0, -1.0, 4.0, 4.0, 0.5])
        values = read(rows(corners), file_rate_hz=file_rate_hz, resample="linear").values
        last_s = 5.0 / file_rate_hz
        assert values.size == int(last_s * RATE_HZ + 1e-9) + 1
        for k, value in enumerate(values):
            at = k / RATE_HZ * file_rate_hz
            i = min(int(at + 1e-9), 4)
            expected = corners[i] + (at - i) * (corners[i + 1] - corners[i])
            assert value == pytest.approx(expected, abs=1e-12)

    def test_cubic(self, read: Read) -> None:
        """Cubic resampling gives a cubic back exactly, where straight lines do not."""
        t = np.arange(41) / 200.0
        cubic = 1.0 - 20.0 * t + 300.0 * t**2 - 900.0 * t**3
        fine_s = np.arange(201) / RATE_HZ
        expected = 1.0 - 20.0 * fine_s + 300.0 * fine_s**2 - 900.0 * fine_s**3
        values = read(rows(cubic), file_rate_hz=200.0, resample="cubic").values
        np.testing.assert_allclose(values, expected, rtol=0.0, atol=1e-11)
        straight = read(rows(cubic), file_rate_hz=200.0, resample="linear").values
        assert np.max(np.abs(straight - expected)) > 1e-4

    def test_row_range_keeps_the_rate(self, read: Read) -> None:
        text = "t_s,x\n" + rows(T_S * 2.0, WAVE)
        part = read(text, column="x", resample="linear", first_row=51, last_row=100)
        assert part.values.size == 99
        np.testing.assert_allclose(part.values[::2], WAVE[50:100], rtol=0.0, atol=1e-12)

    def test_resampled_too_long(self, read: Read, monkeypatch: pytest.MonkeyPatch) -> None:
        with pytest.raises(InputError, match=r"^has 1\.99e\+14 samples"):
            read(rows(WAVE), file_rate_hz=1e-9, resample="linear")
        monkeypatch.setattr(shapes, "MAX_SAMPLES", 300)
        with pytest.raises(InputError, match="398 samples"):
            read(rows(WAVE), file_rate_hz=500.0, resample="linear")


def npy(tmp_path: Path, array: Any) -> bytes:
    np.save(tmp_path / "made.npy", array, allow_pickle=True)
    return (tmp_path / "made.npy").read_bytes()


class TestNpy:
    @pytest.mark.parametrize("name", ["w.npy", "w.csv"])
    def test_rate_is_needed(self, read: Read, tmp_path: Path, name: str) -> None:
        content = npy(tmp_path, WAVE) if name == "w.npy" else rows(WAVE)
        assert "file_rate_hz" in refusal(read, content, name)

    def test_not_finite(self, read: Read, tmp_path: Path) -> None:
        bad = WAVE.copy()
        bad[3] = np.inf
        text = refusal(read, npy(tmp_path, bad), "w.npy", file_rate_hz=RATE_HZ)
        assert text.startswith("row 4: ")

    def test_too_large(self, read: Read, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(shapes, "MAX_SAMPLES", 100)
        text = refusal(read, npy(tmp_path, WAVE), "w.npy", file_rate_hz=RATE_HZ)
        assert text.startswith("has 200 samples")

    def test_objects_are_never_unpickled(self, read: Read, tmp_path: Path) -> None:
        content = npy(tmp_path, np.array([1.0, None], dtype=object))
        text = refusal(read, content, "w.npy", file_rate_hz=RATE_HZ)
        assert "NumPy file" in text

    @pytest.mark.parametrize("cut", [0, 5, 60, 300])
    def test_cut_short(self, read: Read, tmp_path: Path, cut: int) -> None:
        content = npy(tmp_path, WAVE)[:cut]
        text = refusal(read, content, "w.npy", file_rate_hz=RATE_HZ)
        assert "NumPy file" in text

    @pytest.mark.parametrize(
        "array",
        [
            np.float64(3.0),
            np.ones((2, 2, 2)),
            np.array(["a", "b"]),
            np.ones(3) * 1j,
            np.ones((5, 0)),
        ],
    )
    def test_wrong_kind(self, read: Read, tmp_path: Path, array: Any) -> None:
        text = refusal(read, npy(tmp_path, array), "w.npy", file_rate_hz=RATE_HZ)
        assert "array of numbers" in text

    @pytest.mark.parametrize(
        "shape",
        ["(10**15,)", "(1000000000000000,)", "(4294967296, 4294967296)", "(9223372036854775808,)",
         "(-1,)", "(True,)", "(" * 5000, "('''"],
    )  # fmt: skip
    def test_wrong_header_is_refused(self, read: Read, shape: str) -> None:
        head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
        content = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(80)
        text = refusal(read, content, "w.npy", file_rate_hz=RATE_HZ)
        assert "NumPy file" in text


BLOCK = 20


def column(k: int) -> F64:
    """Return the samples of one recorded column: float64[100], each column its own."""
    return k + 0.01 * np.arange(100)


def record(path: Path, firsts: list[int], columns: F64) -> None:
    blocks = len(firsts)
    batch = BlockBatch.empty(blocks, BLOCK, 1)
    batch.heads[:, BlockHeader.FIRST_SAMPLE] = firsts
    batch.heads[:, BlockHeader.SAMPLES] = BLOCK
    batch.heads[1:, BlockHeader.DROPPED_BEFORE] = np.diff(firsts) - BLOCK
    batch.columns[:] = columns.reshape(len(COLUMNS), blocks, BLOCK).transpose(1, 0, 2)
    write_recording(path, batch, RATE_HZ, measured=True)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A recording of 100 samples at 1 kHz."""
    path = tmp_path / "run.mcap"
    record(path, [0, 20, 40, 60, 80], np.array([column(k) for k in range(len(COLUMNS))]))
    return path


@pytest.mark.parametrize(
    ("name", "k"), [("reference_um", 0), ("wanted", 1), ("command", 2), ("displacement_um", 3)]
)
def test_columns(made: Made, recording: Path, name: str, k: int) -> None:
    keys = {"kind": "file", "path": recording.name, "column": name}
    reference = made(RATE_HZ, recording.parent, **keys)
    np.testing.assert_array_equal(reference.values, column(k))
    assert reference.segments[0].label == "file run.mcap"


def test_rows_scale_and_rate(made: Made, recording: Path) -> None:
    keys = {"kind": "file", "path": recording.name, "column": "command", "scale": 2.0}
    part = made(RATE_HZ, recording.parent, **keys, first_row=11, last_row=20)
    np.testing.assert_array_equal(part.values, 2.0 * column(2)[10:20])
    finer = made(2000.0, recording.parent, **keys, resample="linear")
    np.testing.assert_allclose(finer.values, 4.0 + 0.01 * np.arange(199), rtol=0.0, atol=1e-12)
    with pytest.raises(InputError, match="resample"):
        made(2000.0, recording.parent, **keys)


def test_column_is_needed(made: Made, recording: Path) -> None:
    known = "reference_um, displacement_um, command, wanted"
    with pytest.raises(InputError, match=f"one of {known}"):
        made(RATE_HZ, recording.parent, kind="file", path=recording.name)
    with pytest.raises(InputError, match=r"'flags': .*1: reference_um, 2: displacement_um"):
        made(RATE_HZ, recording.parent, kind="file", path=recording.name, column="flags")


def test_gap(made: Made, tmp_path: Path) -> None:
    """A recording that lacks samples is refused: closing the gap would make a step."""
    columns = np.array([column(k) for k in range(len(COLUMNS))])
    record(tmp_path / "run.mcap", [0, 20, 60, 80, 100], columns)
    with pytest.raises(InputError, match="missing"):
        made(RATE_HZ, tmp_path, kind="file", path="run.mcap", column="command")

"""Corrections: what a file holds, where it is added, and for what it is refused."""

import numpy as np
import pytest

from hilctl.base.errors import ConfigError, InputError
from hilctl.base.segments import Segment
from hilctl.experiment.sections.correction import (
    Correction,
    LearnedCycle,
    dump_correction,
    envelope,
    evaluate,
    load_correction,
    signature,
)
from hilctl.models.model_file import model_sha256
from hilctl.waveforms.build import build
from hilctl.waveforms.spec import Sequence, Sine
from tests.published import terfenol_rdpi

RATE_HZ = 10_000.0
COEFFICIENTS = np.array([0.5, 0.2 - 0.1j, 0.0, 0.05j])


def sine(frequency_hz=150.0, amplitude=10.0, soft_s=0.1, **more):
    return Sine(
        kind="sine", unit="um", amplitude=amplitude, frequency_hz=frequency_hz, duration_s=0.5,
        soft_start_s=soft_s, soft_end_s=soft_s, **more,
    )  # fmt: skip


def reference(waveform, tmp_path):
    return build(waveform, RATE_HZ, tmp_path)


def correction_for(made, segment, model=None):
    wanted = signature(made.values, segment)
    cycle = LearnedCycle.from_coefficients(segment.label, segment.period, wanted, COEFFICIENTS)
    return Correction(
        sample_rate_hz=made.sample_rate_hz, model_sha256=model_sha256(model), cycles=(cycle,)
    )


def correction_of(correction, made, model=None):
    return correction.added(made, model)[:] - made.values[:]


def test_a_file_gives_back_the_same_correction(tmp_path):
    made = reference(sine(), tmp_path)
    correction = correction_for(made, made.segments[0])
    text = dump_correction(correction)
    (tmp_path / "c.yaml").write_text(text)
    back = load_correction(tmp_path / "c.yaml")
    assert back == correction
    assert np.array_equal(back.cycles[0].coefficients, COEFFICIENTS)


def test_the_correction_follows_the_phase_where_a_period_is_no_whole_number(tmp_path):
    made = reference(sine(), tmp_path)
    segment = made.segments[0]
    added = correction_of(correction_for(made, segment), made)
    steady = np.arange(segment.steady_start, segment.steady_stop)
    turns = 2.0 * np.pi * steady / segment.period
    expected = 0.5 + 0.4 * np.cos(turns) + 0.2 * np.sin(turns) - 0.1 * np.sin(3.0 * turns)
    assert segment.period == pytest.approx(66.6667, abs=1e-3)
    np.testing.assert_allclose(added[steady], expected, atol=1e-6)


def test_the_correction_fades_with_the_waveform(tmp_path):
    """It starts and ends at 0 and changes no faster than the fade and the cycle themselves."""
    made = reference(sine(), tmp_path)
    segment = made.segments[0]
    added = correction_of(correction_for(made, segment), made)
    assert added[0] == 0.0
    assert abs(added[-1]) < 1e-4
    steady = added[segment.steady_start : segment.steady_stop]
    assert np.abs(np.diff(added)).max() < 1.1 * np.abs(np.diff(steady)).max()


def test_without_a_soft_start_it_fades_in_over_one_period():
    fade = envelope(Segment("x", 0, 1000, 0, 1000, 100.0), np.arange(1000))
    assert fade[0] == 0.0
    assert fade[50] == pytest.approx(0.5)
    assert (fade[100:] == 1.0).all()


def test_only_the_waveform_that_was_learned_is_corrected(tmp_path):
    parts = (sine(100.0), sine(150.0), sine(150.0, amplitude=9.0))
    made = reference(Sequence(kind="sequence", unit="um", parts=parts, repeat=2), tmp_path)
    added = correction_of(correction_for(made, made.segments[1]), made)
    corrected = [bool(added[s.start : s.stop].any()) for s in made.segments]
    assert corrected == [False, True, False] * 2


@pytest.mark.parametrize(
    "other", [sine(151.0), sine(amplitude=10.1), sine(offset=0.1), sine(phase_deg=2.0)]
)
def test_another_waveform_is_refused(other, tmp_path):
    made = reference(sine(), tmp_path)
    correction = correction_for(made, made.segments[0])
    with pytest.raises(InputError, match=r"sine 10 µm 150 Hz"):
        correction.added(reference(other, tmp_path), None)


def test_a_period_may_have_several_cycles_of_the_waveform(tmp_path):
    """That of two axes: the correction repeats with it, and fits no waveform of that period."""
    made = reference(sine(), tmp_path)
    segment = made.segments[0]
    cycle = LearnedCycle.from_coefficients(
        "sine", 3.0 * segment.period, signature(made.values, segment), COEFFICIENTS, 3
    )
    plain = correction_for(made, segment)
    correction = plain.model_copy(update={"cycles": (cycle,)})
    (tmp_path / "c.yaml").write_text(dump_correction(correction))
    back = load_correction(tmp_path / "c.yaml")
    assert back == correction
    added, period = correction_of(back, made), round(3.0 * segment.period)
    np.testing.assert_allclose(
        added[1200 : 1200 + period], added[1200 + period : 1200 + 2 * period]
    )
    assert np.ptp(added[1200:2000] - correction_of(plain, made)[1200:2000]) > 0.1
    slow = reference(sine(50.0), tmp_path)
    with pytest.raises(InputError, match="another waveform"):
        back.added(slow, None)
    assert "waveform_cycles" not in dump_correction(plain)


def test_another_length_or_fade_is_the_same_waveform(tmp_path):
    made = reference(sine(), tmp_path)
    correction = correction_for(made, made.segments[0])
    longer = sine(soft_s=0.2).model_copy(update={"duration_s": 3.0})
    assert np.abs(correction_of(correction, reference(longer, tmp_path))).max() > 0.5


def test_another_rate_or_model_is_refused(tmp_path):
    made = reference(sine(), tmp_path)
    correction = correction_for(made, made.segments[0], terfenol_rdpi())
    with pytest.raises(InputError, match="another model"):
        correction.added(made, None)
    faster = build(sine(), 2.0 * RATE_HZ, tmp_path)
    with pytest.raises(InputError, match=r"at 10000 .* at 20000"):
        correction.added(faster, terfenol_rdpi())


def test_a_file_with_unequal_coefficients_is_refused(tmp_path):
    made = reference(sine(), tmp_path)
    text = dump_correction(correction_for(made, made.segments[0]))
    broken = text.replace("    sine_um:\n    - 0.0\n", "    sine_um:\n")
    assert broken != text
    path = tmp_path / "c.yaml"
    path.write_text(broken)
    with pytest.raises(ConfigError, match="cosine_um: 3 for 4"):
        load_correction(path)


def test_evaluation_drops_what_a_coarse_grid_can_not_show():
    values = evaluate(np.array([1.0, 0.0, 0.5, 0.5, 0.25]), 6)
    np.testing.assert_allclose(values, 1.0 + np.cos(2.0 * 2.0 * np.pi * np.arange(6) / 6))

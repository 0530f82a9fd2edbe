"""Long references: the same samples however divided, and what tells all of them."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hilctl.base import arrays
from hilctl.base.arrays import chunks
from hilctl.base.errors import InputError
from hilctl.waveforms import build, parts, shapes
from hilctl.waveforms.build import Reference
from hilctl.waveforms.parts import Repeat, telling

Made = Callable[..., Reference]
SOFT = {"soft_start_s": 0.31, "soft_end_s": 0.17, "rest": -0.5, "offset": 0.25}
WAVES: list[dict[str, Any]] = [
    {"kind": "sine", "amplitude": 6.0, "frequency_hz": 7.3, "duration_s": 4.0},
    {"kind": "triangle", "amplitude": 6.0, "frequency_hz": 7.3, "duration_s": 4.0},
    {
        "kind": "complex_harmonic",
        "components": (
            {"amplitude": 1.0, "frequency_hz": 3.0},
            {"amplitude": 2.0, "frequency_hz": 4.0, "phase_deg": 20.0},
        ),
        "duration_s": 4.0,
    },
    {"kind": "growing", "amplitude": 6.0, "frequency_hz": 7.3, "duration_s": 4.0},
    {"kind": "chirp", "amplitude": 6.0, "start_hz": 1.0, "stop_hz": 90.0, "duration_s": 4.0},
    {"kind": "step", "levels": (1.0, -2.0, 3.0), "dwell_s": 1.3, "rise_s": 0.1},
    {"kind": "hold", "level": 2.0, "duration_s": 4.0},
    {"kind": "path", "levels": (5.0, -2.0, 3.0), "rate_per_s": 4.0},
    {"kind": "random", "amplitude": 6.0, "first_hz": 2, "last_hz": 90, "duration_s": 4.0},
    {
        "kind": "multisine", "amplitude": 6.0, "first_hz": 5.0, "last_hz": 90.0, "step_hz": 5.0,
        "duration_s": 4.0,
    },
]  # fmt: skip


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let everything be long, and little be processed together."""
    monkeypatch.setattr(shapes, "LONG", 1000)
    for module in (arrays, build, shapes, parts):
        monkeypatch.setattr(module, "CHUNK", 97)


def waveforms() -> list[dict[str, Any]]:
    sequence = {"kind": "sequence", "parts": tuple({**w, **SOFT} for w in WAVES[:-1]), "repeat": 3}
    return [*({**w, **SOFT} for w in WAVES), sequence]


@pytest.mark.parametrize("keys", waveforms(), ids=lambda keys: keys["kind"])
def test_the_same_samples_however_long(
    made: Made, keys: dict[str, Any], request: pytest.FixtureRequest
) -> None:
    """To the last bit, whatever parts they are asked for in; and the same segments and span.

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
    """All values and steps of a long sine stand in its ends and in its first cycles."""
    long = made(1000.0, **WAVES[0] | {"duration_s": 1000.0}, **SOFT)
    told = np.concatenate([*chunks(long.values, long.telling)])
    assert told.size < 5000 < long.values.size
    everything = long.values
    assert told[:310].tolist() == everything[:310].tolist()
    assert told[-170:].tolist() == everything[-170:].tolist()
    assert long.span == pytest.approx((everything.min(), everything.max()), rel=1e-3)


def test_a_repeated_sequence_is_told_by_one_of_it(made: Made, small: None) -> None:
    """And by the way from its end to its beginning."""
    sequence = waveforms()[-1] | {"repeat": 50}
    long = made(1000.0, **sequence)
    first = long.telling[0]
    once = long.values.size // 50
    assert (first.start, first.stop) == (0, once + 97)
    assert long.repeats == (Repeat(0, long.values.size, float(once)),)


def test_what_does_not_repeat_is_told_by_all_of_it(made: Made, small: None) -> None:
    """So is what a file says of its own period."""
    chirp = made(1000.0, **WAVES[4])
    assert chirp.telling == (slice(0, 4000),)


def test_telling_parts() -> None:
    """Nothing twice, nothing left out but the middle of what repeats."""
    n, chunk = 10**9, parts.CHUNK
    (all_of_it,) = telling(n, ())
    assert (all_of_it.start, all_of_it.stop) == (0, n)
    two = (Repeat(100, 4 * 10**8, 500.0), Repeat(5 * 10**8, n, 1e7 / 3.0))
    first, second, last = telling(n, two)
    assert (first.start, first.stop) == (0, 100 + chunk + 500)
    assert second.start == 4 * 10**8 - chunk
    assert second.stop == 5 * 10**8 + chunk + -(-8 * 10**7 // 3)
    assert (last.start, last.stop) == (n - chunk, n)
    assert telling(n, (Repeat(0, chunk, 500.0),)) == (slice(0, n),)


def test_a_value_that_is_none_is_refused_wherever_it_is(made: Made, small: None) -> None:
    keys = {"kind": "growing", "amplitude": 1.7e308, "offset": 1.7e308, "frequency_hz": 0.3}
    with pytest.raises(InputError, match="too large: a value is not finite"):
        made(1000.0, **keys, duration_s=40.0)

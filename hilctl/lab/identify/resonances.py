"""Fit of further modes of the structure to the residual of a model with one mode.

A missing linear part shows in the transfer function from modelled to measured displacement, which
follows from cross-spectra whatever the hysteresis before it. Pairs of resonance and antiresonance
with a clear shape are removed from the records, and the model is fitted to the rest.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares

from hilctl.base.errors import ModelError
from hilctl.base.types import C128, F64
from hilctl.lab.identify.data.records import History, Record
from hilctl.models.linear_stages import MODE_NUMBERS, FurtherMode, modes_of

SEGMENT_S = 0.3  # long compared with the decay of a mode, short compared with a record
FASTEST_HZ = 20e3  # sample rate of the analysis; modes are below a quarter of it
FEWEST_SEGMENTS = 12
FEWEST_BINS = 40
AT_ONCE = 64  # segments transformed together, to limit memory
LOWEST_BIN = 2  # lower ones contain the trend of each segment
WORTH = 0.9  # better modes lower the rms error of a model at least to this share
ROUNDING = 1e-20  # minimum residual of a model, as a share of the power of a displacement
TRIES = 24, (0.01, 0.03, 0.1, 0.3)  # number of frequencies, and damping ratios, of starts
FOLLOWED = 3  # starts that are optimised
APART = 1.4  # minimum frequency ratio to the first mode, whose own error would be nearer
DISTINCT = 1.15  # minimum frequency ratio of two further modes
LEAST_DAMPING, MOST_DAMPING = 2e-3, 0.3
AT_BOUND = 0.98  # a mode with this share of the largest damping is no resonance
NEAR = math.log(2.0)  # maximum of antiresonance over resonance
SMOOTH = 3  # parameters of the smooth part: gain, slope, bend
MOST = 3


@dataclass(frozen=True, slots=True)
class _Spectra:
    """Transfer function from modelled to measured um, its power, and that of the residual."""

    frequency_hz: F64
    transfer: C128
    power: F64
    left: float


def further_modes(
    records: Sequence[History],
    modelled_um: Sequence[F64],
    known: Sequence[FurtherMode],
    first_hz: float | None,
) -> tuple[FurtherMode, ...] | None:
    """Return improved modes, with one more if the residual shows it; None if nothing improves."""
    bare_um = [
        _undone(model_um, known, record.sample_rate_hz)
        for model_um, record in zip(modelled_um, records, strict=True)
    ]
    spectra = _spectra(records, modelled_um, bare_um)
    if spectra is None:
        return None
    x = _packed(known)
    answer = _response(x, spectra.frequency_hz)
    columns = np.stack(_smooth(spectra), axis=1) * answer[:, None]
    bare = replace(spectra, transfer=spectra.transfer - answer + 1.0)
    before = _Pairs(x, _least_squares(bare, columns)[1])
    better = _followed(spectra, before.x, first_hz) if known else before
    more = _one_more(spectra, better.x, first_hz) if len(known) < MOST else None
    rate_hz, chosen = min(record.sample_rate_hz for record in records), better
    if more is not None and _stands(_modes(more.x), first_hz, rate_hz):
        left = _left(spectra, before, better)
        chosen = more if _left(spectra, before, more) < WORTH**2 * left else better
    modes = _modes(chosen.x)
    worth = _left(spectra, before, chosen) < WORTH**2
    return modes if worth and _stands(modes, first_hz, rate_hz) else None


def without_modes(records: Sequence[Record], modes: Sequence[FurtherMode]) -> tuple[Record, ...]:
    """Return records with modes removed from histories."""
    return tuple(
        replace(
            record, displacement_um=_undone(record.displacement_um, modes, record.sample_rate_hz)
        )
        if isinstance(record, History)
        else record
        for record in records
    )


def _undone(y_um: F64, modes: Sequence[FurtherMode], rate_hz: float) -> F64:
    for mode in modes:
        y_um = mode.inverse(rate_hz).process(y_um)
    return y_um


def _spectra(
    records: Sequence[History], modelled_um: Sequence[F64], bare_um: Sequence[F64]
) -> _Spectra | None:
    """Return the transfer function of all records together; None if they are too few."""
    top = min(FASTEST_HZ, *(record.sample_rate_hz for record in records))
    count = int(0.25 * top * SEGMENT_S)
    own, cross, left, segments = np.zeros(count), np.zeros(count, np.complex128), 0.0, 0
    for record, model_um, um in zip(records, modelled_um, bare_um, strict=True):
        measured_um = record.displacement_um[record.ignore :]
        signals = np.stack((measured_um - model_um, um, measured_um))
        for error, x, y in _pieces(signals, record.sample_rate_hz):
            left += float(np.sum(np.abs(error) ** 2))
            own += np.sum(np.abs(x[:, :count]) ** 2, axis=0)
            cross += np.sum(np.conj(x[:, :count]) * y[:, :count], axis=0)
            segments += len(x)
    if segments < FEWEST_SEGMENTS or count < FEWEST_BINS:
        return None
    bins = slice(LOWEST_BIN, None)
    return _Spectra(
        frequency_hz=(np.arange(count) / SEGMENT_S)[bins],
        transfer=np.asarray(cross / np.maximum(own, 1e-300), dtype=np.complex128)[bins],
        power=own[bins],
        # A residual of 0 would make every change of rounding an improvement.
        left=max(left, ROUNDING * float(own.sum()), 1e-300),
    )


def _pieces(signals: F64, rate_hz: float) -> Iterator[C128]:
    """Yield windowed spectra of segments of signals, float64[s, n]: complex128[s, m, k]."""
    together = max(1, int(rate_hz / FASTEST_HZ))
    size = round(SEGMENT_S * rate_hz / together)
    whole = signals[:, : signals.shape[1] // together * together]
    coarse = whole.reshape(len(signals), -1, together).mean(axis=2)
    if coarse.shape[1] < size:
        return
    views = np.lib.stride_tricks.sliding_window_view(coarse, size, axis=1)[:, :: size // 2]
    window = np.hanning(size)
    for first in range(0, views.shape[1], AT_ONCE):
        part = views[:, first : first + AT_ONCE]
        yield np.fft.rfft((part - part.mean(axis=2, keepdims=True)) * window)


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Pairs of resonance and antiresonance, and a smooth part."""

    # float64[4 m + 3]: logarithms of each pair's frequency, damping, ratio, damping; smooth part
    x: F64
    misfit: float  # residual of the transfer function, in power


def _left(spectra: _Spectra, before: _Pairs, now: _Pairs) -> float:
    """Return the remaining part of a model's error, in power, except the smooth part."""
    return 1.0 - (before.misfit - now.misfit) / spectra.left


def _one_more(spectra: _Spectra, x: F64, first_hz: float | None) -> _Pairs | None:
    """Return the best pairs with one more; None if none can be tried."""
    known = _response(x, spectra.frequency_hz)
    rest = replace(
        spectra, transfer=spectra.transfer / known, power=spectra.power * np.abs(known) ** 2
    )
    count, dampings = TRIES
    low, high = 4.0 * spectra.frequency_hz[0], 0.8 * spectra.frequency_hz[-1]
    tried = [
        _tried(rest, natural_hz, damping)
        for natural_hz in np.geomspace(low, high, count).tolist()
        if _apart(natural_hz, first_hz)
        for damping in dampings
    ]
    best = sorted(tried, key=lambda pairs: pairs.misfit)[:FOLLOWED]
    starts = [np.concatenate((x[:-SMOOTH], pairs.x)) for pairs in best]
    ends = [_followed(spectra, start, first_hz) for start in starts]
    return min(ends, key=lambda pairs: pairs.misfit, default=None)


def _apart(natural_hz: float, first_hz: float | None) -> bool:
    return first_hz is None or not 1.0 / APART < natural_hz / first_hz < APART


def _tried(spectra: _Spectra, natural_hz: float, damping: float) -> _Pairs:
    """Return the best pair with a given resonance."""
    s = 1j * spectra.frequency_hz / natural_hz
    columns = [*_smooth(spectra), s**2 / (1.0 + 2.0 * damping * s + s**2)]
    found, misfit = _least_squares(spectra, np.stack(columns, axis=1))
    bend = min(max(1.0 + float(found[3]), 0.3), 3.0)  # one over the antiresonance squared
    pair = math.log(natural_hz), math.log(damping), -0.5 * math.log(bend), math.log(damping)
    return _Pairs(np.array([*pair, *found[:3]]), misfit)


def _smooth(spectra: _Spectra) -> tuple[C128, C128, C128]:
    """Return the columns of gain, slope and bend: complex128[k] each."""
    s = 1j * spectra.frequency_hz / spectra.frequency_hz[-1]
    return np.ones_like(s), s, s**2


def _least_squares(spectra: _Spectra, columns: C128) -> tuple[F64, float]:
    """Return real weights of columns that fit the transfer function less 1, and the misfit."""
    scale = np.sqrt(spectra.power)
    rows, target = columns * scale[:, None], (spectra.transfer - 1.0) * scale
    both = np.concatenate((rows.real, rows.imag)), np.concatenate((target.real, target.imag))
    found = np.linalg.lstsq(*both, rcond=None)[0]
    return np.asarray(found, dtype=np.float64), float(np.sum((both[0] @ found - both[1]) ** 2))


def _followed(spectra: _Spectra, start: F64, first_hz: float | None) -> _Pairs:
    """Optimise pairs from a start; each stays on its side of the first mode."""
    low, high = _bounds(spectra, start, first_hz)
    scale, smooth = np.sqrt(spectra.power), np.stack(_smooth(spectra), axis=1)

    def residuals(x: F64) -> F64:
        answer = _response(x, spectra.frequency_hz) * (1.0 + smooth @ x[-SMOOTH:])
        off = (answer - spectra.transfer) * scale
        return np.concatenate((off.real, off.imag))

    begin = np.clip(start, low, high)
    end = least_squares(residuals, begin, bounds=(low, high), x_scale="jac", max_nfev=60)
    return _Pairs(end.x, 2.0 * float(end.cost))


def _bounds(spectra: _Spectra, x: F64, first_hz: float | None) -> tuple[F64, F64]:
    low, high = np.full(x.size, -9.0), np.full(x.size, 9.0)
    bottom, top = math.log(spectra.frequency_hz[0]), math.log(spectra.frequency_hz[-1])
    dampings = math.log(LEAST_DAMPING), math.log(MOST_DAMPING)
    for k in range(0, x.size - SMOOTH, MODE_NUMBERS):
        ends = bottom, top
        if first_hz is not None:
            first = math.log(first_hz)
            below = x[k] < first
            ends = (bottom, first - math.log(APART)) if below else (first + math.log(APART), top)
        low[k : k + MODE_NUMBERS] = ends[0], dampings[0], -NEAR, dampings[0]
        high[k : k + MODE_NUMBERS] = ends[1], dampings[1], NEAR, dampings[1]
    return low, high


def _packed(modes: Sequence[FurtherMode]) -> F64:
    """Return modes as ``_Pairs.x`` with a smooth part of 0."""
    numbers: list[float] = []
    for each in modes:
        ratio = each.antiresonance_hz / each.natural_hz
        both = each.natural_hz, each.damping_ratio, ratio, each.antiresonance_damping_ratio
        numbers += [math.log(number) for number in both]
    return np.array([*numbers, *[0.0] * SMOOTH])


def _modes(x: F64) -> tuple[FurtherMode, ...]:
    """Undo :func:`_packed`."""
    return modes_of(x[:-SMOOTH])


def _response(x: F64, frequency_hz: F64) -> C128:
    answer = np.ones(frequency_hz.size, complex)
    for mode in _modes(x):
        answer *= mode.response(frequency_hz)
    return answer


def _stands(modes: Sequence[FurtherMode], first_hz: float | None, rate_hz: float) -> bool:
    """Return whether modes are distinct resonances and have an inverse."""
    ends = [hz for mode in modes for hz in (mode.natural_hz, mode.antiresonance_hz)]
    ladder = sorted(mode.natural_hz for mode in modes)
    if not all(_apart(hz, first_hz) for hz in ends):
        return False
    dampings = [z for mode in modes for z in (mode.damping_ratio, mode.antiresonance_damping_ratio)]
    if max(dampings) > AT_BOUND * MOST_DAMPING:
        return False
    if any(after < DISTINCT * before for before, after in pairwise(ladder)):
        return False
    try:
        for mode in modes:
            mode.inverse(rate_hz)
    except ModelError:
        return False
    return True

"""Frequency response of a recording: multisine, random, chirp or a sequence of sines, and its fit.

The displacement of a sample is read when its command is output. Each command is held for a sample,
which delays the response by half a sample and attenuates high frequencies. The fit accounts for
both, so the fitted delay and lag exclude them.

Sources: R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach (2012), for
periodic excitation and free lines; J. S. Bendat, A. G. Piersol, Random Data (2010), for the errors
of averaged spectra.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from scipy import signal

from hilctl.analysis.steady_state import steady_part, steady_samples
from hilctl.base.errors import DataError, InputError
from hilctl.base.formatting import shown_briefly
from hilctl.base.segments import Segment
from hilctl.base.types import C128, F64, I64
from hilctl.lab.identify.data.data_files import without_gaps
from hilctl.lab.response.response_fit import fitted_fields
from hilctl.lab.spectrum import each_cycle
from hilctl.models.linear_stages import FirstMode, FurtherMode
from hilctl.recording.recording import Recording

Signals: TypeAlias = Literal[
    "command-displacement", "reference-displacement", "input-displacement", "command-measured"
]
Method: TypeAlias = Literal["periods", "averaged spectra", "sines"]
SIGNALS: tuple[Signals, ...] = get_args(Signals)

_FEWEST_LINES = 4
_FEWEST_PERIODS = 2
_STRONG = 0.2  # excited lines of a multisine, as a share of the largest line of its input
_WEAK = 1e-3  # lines of another input that are not excited, as a share of its largest power
_AVERAGES = {"chirp": 4}  # segments that fit side by side; overlapping, nearly twice as many
_MOST_AVERAGES = 16  # the same for other waveforms; a resonance must decay within a segment
_OVERLAP = 1.056  # loss of averages, because half of each Hann window is in the next one
_USABLE = 0.3  # largest relative noise of a line


class NoisyResponseError(DataError):
    """Too few frequencies are above the noise."""


@dataclass(frozen=True, slots=True)
class FreeLines:
    """Output at lines that a multisine does not excite, rms per line, in percent of excited lines.

    Output above the noise is nonlinear distortion; nan without such lines.
    """

    even_percent: float
    odd_percent: float
    noise_percent: float


@shown_briefly
@dataclass(frozen=True, slots=True)
class FrequencyResponse:
    """Frequency response of a run.

    Attributes:
        signals: Input and output.
        unit: Unit of the response, such as ``um/A``.
        excitation: The excitation in words.
        method: Evaluation of the excitation.
        averages: Number of periods or averaged spectra, or the fewest cycles of a sine.
        amplitude: Half the peak-to-peak of the input.
        frequency_hz: float64[k], those above the noise.
        response: complex128[k], output over input as sampled (H1).
        noise: float64[k], standard deviation of each.
        coherence: float64[k], 0 to 1.
        free: Output at lines that are not excited; None unless a multisine leaves some.
        gain_um: Gain at low frequencies, in ``unit``; negative if the output falls.
        delay_s: Delay, without the half sample by which holding each command delays it.
        lag_s: Time constant of a first-order lag; 0 for none.
        natural_hz: Natural frequency; None without a resonance.
        damping_ratio: Its damping ratio; None without a resonance.
        further: Further modes, with their antiresonances.
        bandwidth_hz: -3 dB bandwidth; None if it is above the measured frequencies.
        errors: Standard errors of the fit, by the names of these fields.
        misfit_percent: rms residual of the fit, of the gain.
        fitted: complex128[k], the fitted response.
    """

    path: Path
    signals: Signals
    unit: str
    excitation: str
    method: Method
    averages: int
    amplitude: float
    excited_lines: int
    frequency_hz: F64
    response: C128
    noise: F64
    coherence: F64
    free: FreeLines | None
    gain_um: float
    delay_s: float
    lag_s: float
    natural_hz: float | None
    damping_ratio: float | None
    further: tuple[FurtherMode, ...]
    bandwidth_hz: float | None
    errors: Mapping[str, float]
    misfit_percent: float
    fitted: C128

    @property
    def structure(self) -> FirstMode | None:
        """The resonance as a stage of a model; None without one."""
        if self.natural_hz is None or self.damping_ratio is None:
            return None
        return FirstMode(natural_hz=self.natural_hz, damping_ratio=self.damping_ratio)

    @property
    def quality(self) -> float | None:
        """Quality factor Q of the resonance; None without one."""
        return 0.5 / self.damping_ratio if self.damping_ratio else None

    @property
    def h2(self) -> C128:
        """The estimate H2, without bias by noise of the input: complex128[k]."""
        return self.response / self.coherence

    @property
    def phase_deg(self) -> F64:
        """Continuous phase: float64[k]."""
        return np.degrees(np.unwrap(np.angle(self.response)))

    def size_at(self, frequency_hz: float) -> float:
        """Return the fitted magnitude at a frequency, relative to the lowest line."""
        size = np.abs(self.fitted)
        return float(np.interp(frequency_hz, self.frequency_hz, size) / size[0])

    def to_scipy(self) -> signal.TransferFunction:
        """Return the fit without its delay as a continuous transfer function."""
        zeros, poles = np.array([self.gain_um]), np.array([self.lag_s, 1.0])
        if (first := self.structure) is not None:
            poles = np.polymul(poles, _polynomial(first.natural_hz, first.damping_ratio))
        for mode in self.further:
            poles = np.polymul(poles, _polynomial(mode.natural_hz, mode.damping_ratio))
            antiresonance = mode.antiresonance_hz, mode.antiresonance_damping_ratio
            zeros = np.polymul(zeros, _polynomial(*antiresonance))
        return signal.TransferFunction(zeros, poles)  # removes a leading zero

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, as ``hilctl frf --json`` prints them."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        del found["response"], found["fitted"]
        arrays = {
            "frequency_hz": self.frequency_hz,
            "magnitude": np.abs(self.response),
            "phase_deg": self.phase_deg,
            "coherence": self.coherence,
            "noise": self.noise,
        }
        return {
            **found,
            "path": str(self.path),
            "quality": self.quality,
            "errors": dict(self.errors),
            "free": self.free and asdict(self.free),
            "further": [each.model_dump() for each in self.further],
            **{name: values.tolist() for name, values in arrays.items()},
        }


def _polynomial(natural_hz: float, damping_ratio: float) -> F64:
    """Return the coefficients of a second-order factor, the highest power first."""
    omega = 2.0 * math.pi * natural_hz
    return np.array([omega**-2, 2.0 * damping_ratio / omega, 1.0])


class Lines(NamedTuple):
    """Response at the excited frequencies: fields of :class:`FrequencyResponse`."""

    frequency_hz: F64
    response: C128
    noise: F64
    coherence: F64
    amplitude: float
    averages: int
    free: FreeLines | None = None
    method: Method = "sines"
    excitation: str = ""
    excited_lines: int = 0


def frequency_response(recording: Recording, signals: Signals | None = None) -> FrequencyResponse:
    """Return the response of a run's last multisine, random or chirp segment, or of all its sines.

    Raises:
        InputError: The signals are not recorded.
        DataError: The run has no such segment, or too many samples are missing.
        NoisyResponseError: Too few frequencies are above the noise.
    """
    default = SIGNALS[1] if recording.compensated else SIGNALS[0]
    signals = signals or default
    lines = measured_lines(recording, signals)
    sent, answered = signals.split("-")
    units = {"command": recording.command_unit, "measured": recording.command_unit}
    return FrequencyResponse(
        path=recording.path,
        signals=signals,
        unit=f"{units.get(answered, 'um')}/{units.get(sent, 'um')}",
        **lines._asdict(),
        **fitted_fields(*lines[:3], recording.sample_rate_hz, held=sent == "command"),
    )


def measured_lines(recording: Recording, signals: Signals) -> Lines:
    """Return the lines above the noise without a fit, see :func:`frequency_response`."""
    lines = excited_lines(recording, signals)
    excited = lines.excited_lines
    usable = lines.noise < _USABLE * np.abs(lines.response)
    if np.count_nonzero(usable) < _FEWEST_LINES:
        raise NoisyResponseError(
            f"{recording.path}: only {np.count_nonzero(usable)} of {excited} frequencies are above"
            f" the noise, fewer than {_FEWEST_LINES}: increase the amplitude or the duration"
        )
    hz, excitation = lines.frequency_hz[usable], lines.excitation
    if lines.method == "sines":
        excitation = f"{excited} sines {hz[0]:g}-{hz[-1]:g} Hz"
    return lines._replace(
        frequency_hz=hz,
        response=lines.response[usable],
        noise=lines.noise[usable],
        coherence=lines.coherence[usable],
        excitation=excitation,
    )


def excited_lines(recording: Recording, signals: Signals) -> Lines:
    """Return all excited lines, also those below the noise; see :func:`frequency_response`."""
    columns = _columns(recording, signals)
    segments, method = _excitation(recording)
    if method == "sines":
        lines = _sines(recording, segments, columns)
    else:
        lines, method = _broad(recording, segments[0], columns, method)
    return lines._replace(
        method=method,
        excitation=segments[0].label,
        excited_lines=lines.frequency_hz.size,
    )


def _columns(recording: Recording, signals: Signals) -> list[str]:
    """Return the columns of input and output."""
    units = {"displacement": "_um", "reference": "_um", "input": "_um"}
    columns = [f"{each}{units.get(each, '')}" for each in signals.split("-")]
    if not recording.samples.index.size:
        raise DataError(f"{recording.path}: contains no samples")
    for name in columns:
        if not np.isfinite(recording.samples.column(name)).any():
            raise InputError(f"{recording.path}: {name} is not recorded: use other --signals")
    return columns


def _excitation(recording: Recording) -> tuple[list[Segment], Method]:
    """Return the evaluated segments and the method."""
    kinds: dict[str, Method] = {
        "multisine": "periods",
        "random": "averaged spectra",
        "chirp": "averaged spectra",
    }
    broad = [each for each in recording.segments if each.kind in kinds]
    if broad:
        return broad[-1:], kinds[broad[-1].kind]
    sines = [each for each in recording.segments if each.kind == "sine"]
    if len({each.period for each in sines}) >= _FEWEST_LINES:
        return sorted(sines, key=lambda each: -each.period), "sines"
    found = ", ".join(each.label for each in recording.segments) or "no waveform"
    raise DataError(
        f"{recording.path}: has no multisine, random or chirp segment, and no {_FEWEST_LINES} sines"
        f" of different frequency ({found}): record one, as in hilctl examples frequency_response"
    )


def _broad(
    recording: Recording, segment: Segment, columns: Sequence[str], method: Method
) -> tuple[Lines, Method]:
    """Return the lines of one segment, from whole periods if it has them."""
    samples = steady_part(recording, segment).samples
    if not samples.index.size:
        raise DataError(f"{recording.path}: {segment.label}: no steady sample is recorded")
    start, stop = int(samples.index[0]), int(samples.index[-1]) + 1
    period = round(segment.period)
    periods = (stop - start) // period if abs(segment.period - period) < 1e-6 and period else 0
    if periods < _FEWEST_PERIODS:
        method = "averaged spectra"
    else:
        start = stop - periods * period
    sent, answered = without_gaps(replace(recording, samples=samples), start, stop, *columns)
    if method == "periods":
        return _periods(sent, answered, periods, recording.sample_rate_hz), method
    size = sent.size // _AVERAGES.get(segment.kind, _MOST_AVERAGES)
    return _averaged(sent, answered, size, recording.sample_rate_hz), method


def _periods(sent: F64, answered: F64, periods: int, rate_hz: float) -> Lines:
    """Return the lines of a multisine from whole periods, with their scatter."""
    period = sent.size // periods
    shape = periods, period
    # Drift between periods: a line through the samples would remove low frequencies.
    means = answered.reshape(shape).mean(axis=1)
    slope = np.polynomial.polynomial.polyfit(np.arange(periods), means, 1)[1]
    answered = answered - slope * np.arange(answered.size) / period
    x, y = np.fft.rfft(sent.reshape(shape)), np.fft.rfft(answered.reshape(shape))
    size = np.abs(x.mean(axis=0))
    size[0] = 0.0
    excited = np.flatnonzero(size > _STRONG * size.max())
    response, noise, coherence = _scattered(x[:, excited], y[:, excited])
    spectra = y.mean(axis=0), np.sum(np.abs(y - y.mean(axis=0)) ** 2, axis=0)
    variance = spectra[1] / (periods * (periods - 1))
    return Lines(
        excited * rate_hz / period,
        response,
        noise,
        coherence,
        0.5 * float(np.ptp(sent)),
        periods,
        _free_lines(excited, np.abs(spectra[0]) ** 2, variance),
    )


def _scattered(x: C128, y: C128) -> tuple[C128, F64, F64]:
    """Return response, noise and coherence of spectra of each period: complex128[periods, k]."""
    periods = len(x)
    cross, own = np.sum(np.conj(x) * y, axis=0), np.sum(np.abs(x) ** 2, axis=0)
    response = cross / own
    left = np.sum(np.abs(y - response * x) ** 2, axis=0)
    noise = np.sqrt(left / ((periods - 1) * own))
    coherence = np.abs(cross) ** 2 / (own * np.maximum(np.sum(np.abs(y) ** 2, axis=0), 1e-300))
    return response, noise, coherence


def _free_lines(excited: I64, power: F64, variance: F64) -> FreeLines | None:
    """Evaluate the lines between the first and the last excited one by their average power."""
    if not excited.size:
        return None
    between = np.arange(excited[0], excited[-1])
    free = between[~np.isin(between, excited)]
    if not free.size:
        return None
    scale = 1e4 / float(power[excited].mean())

    def percent(values: F64) -> float:
        return math.sqrt(scale * float(values.mean())) if values.size else math.nan

    even = free[free % 2 == 0]
    odd = free[free % 2 == 1]
    return FreeLines(percent(power[even]), percent(power[odd]), percent(variance[free]))


def _averaged(sent: F64, answered: F64, size: int, rate_hz: float) -> Lines:
    """Return the response from averaged cross-spectra (Welch, H1) of segments of a size."""
    if size < 2 * _FEWEST_LINES:
        raise DataError(f"only {sent.size} samples: record a longer run")
    settings: Mapping[str, Any] = {"fs": rate_hz, "nperseg": size}
    hz, own = signal.welch(sent, **settings)
    cross, coherence = (f(sent, answered, **settings)[1] for f in (signal.csd, signal.coherence))
    excited = own > _WEAK * own[1:].max()
    excited[:2] = False  # the mean leaks into the first line
    hz, own, cross, coherence = (each[excited] for each in (hz, own, cross, coherence))
    averages = (sent.size - size // 2) // (size - size // 2)
    coherence = np.clip(coherence, 1e-12, 1.0)
    relative = np.sqrt((1.0 - coherence) / (2.0 * coherence * averages / _OVERLAP))
    response = cross / own
    noise = relative * np.abs(response)
    return Lines(hz, response, noise, coherence, 0.5 * float(np.ptp(sent)), averages)


def _sines(recording: Recording, segments: list[Segment], columns: Sequence[str]) -> Lines:
    """Return one line per sine, from its steady cycles."""
    found = []
    for segment in segments:
        samples, cycles = steady_samples(recording, segment)
        since = samples.index - segment.start
        values = [samples.column(name) for name in columns]
        if cycles >= _FEWEST_PERIODS:
            x, y = (each_cycle(since, segment.period, each, cycles)[:, 1:2] for each in values)
            found.append((segment, cycles, values[0], _scattered(x, y)))
    if len(found) < _FEWEST_LINES:
        rule = f"only {len(found)} sines have {_FEWEST_PERIODS} steady cycles"
        raise DataError(f"{recording.path}: {rule}, fewer than {_FEWEST_LINES}: make them longer")
    response, noise, coherence = (np.concatenate([line[k] for *_, line in found]) for k in range(3))
    return Lines(
        np.array([recording.sample_rate_hz / segment.period for segment, *_ in found]),
        response,
        noise,
        coherence,
        max(0.5 * float(np.ptp(sent)) for _, _, sent, _ in found),
        min(cycles for _, cycles, *_ in found),
    )

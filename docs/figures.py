"""Draw the figures of the pages with the code of hilctl.

conf.py draws the figures of the theory before each build, into ``_generated/figures``. Figures of
runs are stored: ``python docs/figures.py`` redraws ``pictures/before_and_after.png``.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure

from hilctl import api
from hilctl.base.types import F64
from hilctl.kernels.hysteresis import stop_step
from hilctl.lab.pages.plot_style import COMMAND, DISPLACEMENT, ERROR, MARK, QUIET, REFERENCE, STYLE
from hilctl.models.base import HysteresisModel
from hilctl.models.effective_field import FieldLosses, FieldModel, OutputCurve
from hilctl.models.generalised_duhem import GeneralisedDuhemModel
from hilctl.models.integrated import DeadbandFunction, IntegratedModel
from hilctl.models.literature.bouc_wen import BoucWenModel
from hilctl.models.literature.butterfly import ButterflyModel
from hilctl.models.literature.duhem import DuhemModel
from hilctl.models.literature.generalised_plays import GeneralisedModel, PlayEnvelope
from hilctl.models.literature.krasnoselskii import KrasnoselskiiPokrovskiiModel
from hilctl.models.literature.preisach import PreisachModel
from hilctl.models.model_file import load_model
from hilctl.models.plays import PpiModel, RdpiModel
from hilctl.models.staged import FieldLag, FirstMode, StagedModel

ROOT = Path(__file__).parents[1]
MODELS = ROOT / "configs" / "models"
RATE_HZ = 20_000.0
COLOURS = (DISPLACEMENT, COMMAND, ERROR, MARK)


def draw_all(folder: Path) -> None:
    """Draw the figures of the theory, as SVG.

    Args:
        folder: Output folder; created if it is missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context({**STYLE, "svg.fonttype": "none", "text.parse_math": True}):
        for draw in FIGURES:
            draw().savefig(folder / f"{draw.__name__}.svg", metadata={"Date": None})


def draw_before_and_after(path: Path) -> None:
    """Draw the result of the tutorial: the loop of a run without and with the inverse.

    Args:
        path: PNG file to write.
    """
    settings = {"waveform.frequency_hz": 100.0, "waveform.duration_s": 1.0}
    with tempfile.TemporaryDirectory() as folder:
        runs = [
            api.run(
                ROOT / "configs" / f"{name}.yaml",
                Path(folder) / f"{name}.mcap",
                settings=settings,
                fast=True,
            ).path
            for name in ("terfenol_sine_6a_uncompensated", "terfenol_sine_6a")
        ]
        figure = api.figures(runs)["before_and_after"][0].figure
    with mpl.rc_context(STYLE):
        figure.savefig(path, dpi=150, metadata={"Software": None})


def panels(count: int, *, height: float = 2.4) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels side by side."""
    figure = Figure(figsize=(6.9, height))
    return figure, [figure.add_subplot(1, count, i + 1) for i in range(count)]


def dying(cycles: int, amplitude: float, each: int = 400) -> F64:
    """Return a sine whose amplitude decreases to a fifth: a major loop with minor loops."""
    phase = np.linspace(0.0, 2.0 * np.pi * cycles, cycles * each)
    envelope: F64 = amplitude * np.linspace(1.0, 0.2, phase.size) * np.sin(phase)
    return envelope


def steady(model: HysteresisModel, v: F64, rate_hz: float = RATE_HZ) -> tuple[F64, F64]:
    """Return the last of three cycles: input and output of the model."""
    y = model.forward(rate_hz).process(np.tile(v, 3))
    return v, y[-v.size :]


def sine(amplitude: float, samples: int = 600) -> F64:
    """Return a cycle."""
    wave: F64 = amplitude * np.sin(np.linspace(0.0, 2.0 * np.pi, samples, endpoint=False))
    return wave


def one_play(threshold: float) -> PpiModel:
    """Return a model close to a single play: its direct weight is negligible."""
    return PpiModel(direct=1e-9, weights=(1.0,), thresholds=(threshold,))


def named(axes: Axes, title: str, x: str, y: str) -> None:
    """Set the title and axis labels of a panel."""
    axes.set_title(title)
    axes.set_xlabel(x)
    axes.set_ylabel(y)


def play_and_stop() -> Figure:
    """Draw play and stop of one threshold with a decaying input."""
    figure, (over, left, right) = panels(3)
    v = dying(3, 1.0)
    play = one_play(0.3).forward(RATE_HZ).process(v)
    stop = np.empty_like(v)
    held, before = 0.0, 0.0
    for k, value in enumerate(v):
        held = stop_step(value, before, 0.3, held)
        before, stop[k] = value, held
    over.plot(v, color=QUIET, label="input")
    over.plot(play, color=DISPLACEMENT, label="play")
    over.plot(stop, color=COMMAND, label="stop")
    over.legend(loc="lower right")
    named(over, "over time", "sample", "")
    left.plot(v, play, color=DISPLACEMENT)
    named(left, "play, r = 0.3", "v", "F[v]")
    right.plot(v, stop, color=COMMAND)
    named(right, "stop, r = 0.3", "v", "E[v]")
    return figure


def plays_and_their_inverse() -> Figure:
    """Draw a sum of plays, its inverse, and both in series."""
    figure, (left, middle, right) = panels(3)
    model = PpiModel(direct=0.5, weights=(0.4, 0.3, 0.3), thresholds=(0.15, 0.35, 0.6))
    v = dying(3, 1.0)
    y = model.forward(RATE_HZ).process(v)
    left.plot(v, y, color=COMMAND)
    named(left, "model", "command v", "displacement y")
    inverse = model.inverse(RATE_HZ).process(y)
    middle.plot(y, inverse, color=DISPLACEMENT)
    named(middle, "its inverse", "reference y", "command v")
    right.plot(y, model.forward(RATE_HZ).process(inverse), color=ERROR)
    named(right, "inverse, then model", "reference y", "displacement y")
    return figure


def rate_dependent_plays() -> Figure:
    """Draw loops of the rate-dependent model at three frequencies."""
    model = load_model(MODELS / "terfenol_rdpi.yaml")
    assert isinstance(model, RdpiModel)
    figure, (left, right) = panels(2)
    amplitude = model.input_range[1] if model.input_range else 1.0
    for frequency_hz, colour in zip((1.0, 100.0, 200.0), COLOURS, strict=False):
        left.plot(
            *steady(model, sine(amplitude), 600 * frequency_hz),
            color=colour,
            label=f"{frequency_hz:g} Hz",
        )
    left.legend()
    named(left, "terfenol_rdpi.yaml", "command, A", "displacement, µm")
    rate = np.linspace(0.0, 2.0 * np.pi * 200.0 * amplitude, 50)
    for threshold in model.thresholds:
        right.plot(rate, threshold + model.threshold_growth_s * rate, color=QUIET)
    named(right, "its thresholds", "rate of the command, A/s", "A")
    return figure


def deadbands() -> Figure:
    """Draw the memoryless function of deadbands of a shipped model and its inverse."""
    model = omega()
    figure, (left, right) = panels(2)
    x = np.linspace(-16.0, 60.0, 400)
    left.plot(x, model.deadband(x), color=COMMAND)
    left.plot(x, x, ":", color=REFERENCE)
    named(left, "Λ", "x", "Λ(x), µm")
    y = model.deadband(x)
    right.plot(y, model.deadband.inverse()(y), color=DISPLACEMENT)
    right.plot(y, y, ":", color=REFERENCE)
    named(right, "its inverse", "y, µm", "Λ⁻¹(y)")
    return figure


def omega() -> IntegratedModel:
    """Return the shipped integrated model."""
    model = load_model(MODELS / "terfenol_omega.yaml")
    assert isinstance(model, IntegratedModel)
    return model


def integrated() -> Figure:
    """Draw the integrated model at three frequencies, and the commands of its inverse."""
    model = omega()
    figure, (left, right) = panels(2)
    for frequency_hz, colour in zip((1.0, 100.0, 250.0), COLOURS, strict=False):
        loop = steady(model, sine(6.0), 600 * frequency_hz)
        left.plot(*loop, color=colour, label=f"{frequency_hz:g} Hz")
        reference = 40.8 * sine(1.0) - 6.9
        command = model.inverse(600 * frequency_hz).process(np.tile(reference, 3))[-600:]
        right.plot(reference, command, color=colour)
    left.legend()
    named(left, "terfenol_omega.yaml", "command, A", "displacement, µm")
    named(right, "its inverse", "reference, µm", "command, A")
    return figure


def stages() -> Figure:
    """Draw the field lag after a step, and the frequency response of the structure."""
    figure, (left, right) = panels(2)
    rate_hz = 200_000.0
    step = np.concatenate((np.zeros(40), np.ones(360)))
    t_ms = np.arange(step.size) / rate_hz * 1e3
    left.plot(t_ms, step, ":", color=REFERENCE, label="command")
    for growth, colour in ((0.0, DISPLACEMENT), (1.0, COMMAND)):
        field = FieldLag(tau_s=2e-4, growth_per_unit=growth).forward(rate_hz).process(step)
        left.plot(t_ms, field, color=colour, label=f"b = {growth:g}")
    left.legend(loc="lower right")
    named(left, "field lag, τ = 0.2 ms", "time, ms", "field")
    f_hz = np.geomspace(10.0, 10_000.0, 300)
    for damping, colour in ((0.1, DISPLACEMENT), (0.4, COMMAND)):
        structure = FirstMode(natural_hz=2250.0, damping_ratio=damping)
        s = 1j * f_hz / structure.natural_hz
        right.loglog(f_hz, np.abs(1.0 / (s**2 + 2.0 * damping * s + 1.0)), color=colour,
                     label=f"ζ = {damping:g}")  # fmt: skip
    right.legend(loc="lower left")
    named(right, "structure, 2250 Hz", "frequency, Hz", "gain")
    return figure


def staged_inverse() -> Figure:
    """Draw a triangle after the inverse of the staged model, which rounds its corners."""
    model = load_model(MODELS / "terfenol_staged.yaml")
    figure, (left, middle, right) = panels(3)
    rate_hz, period = 50_000.0, 500
    cycle = np.interp(np.arange(period), [0, period // 2, period], [-1.0, 1.0, -1.0])
    reference = np.tile(30.0 * cycle - 8.0, 5)
    inverse = model.inverse(rate_hz)
    command = inverse.process(reference)[inverse.preview :]
    displacement = model.forward(rate_hz).process(command)
    shown = slice(3 * period, 4 * period)
    t_ms = np.arange(period) / rate_hz * 1e3
    left.plot(t_ms, reference[shown], ":", color=REFERENCE, label="reference")
    left.plot(t_ms, displacement[shown], color=DISPLACEMENT, label="displacement")
    left.legend(loc="lower center")
    named(left, "triangle, 100 Hz", "time, ms", "µm")
    middle.plot(t_ms, reference[shown] - displacement[shown], color=ERROR)
    named(middle, "error", "time, ms", "µm")
    right.plot(t_ms, command[shown], color=COMMAND)
    named(right, "command", "time, ms", "A")
    return figure


def preisach() -> Figure:
    """Draw the weights on the triangle of a shipped model, and small loops inside a large one."""
    model = load_model(MODELS / "terfenol_staged_preisach.yaml")
    assert isinstance(model, StagedModel)
    inner = model.hysteresis
    assert isinstance(inner, PreisachModel)
    figure, (left, right) = panels(2)
    slopes = np.array(inner.slopes)
    edges = inner.lowest + inner.cell * np.arange(slopes.shape[1] + 1)
    lines = np.append(inner.thresholds, 2 * inner.thresholds[-1] - inner.thresholds[-2])
    shade = left.pcolormesh(edges, lines, slopes, cmap="cividis",
                           norm=PowerNorm(0.4), rasterized=True)  # fmt: skip
    figure.colorbar(shade, ax=left, label="density, µm/A")
    named(left, "terfenol_staged_preisach.yaml", "centre s, A", "half width r, A")
    v = dying(6, 6.0)
    right.plot(v, inner.forward(RATE_HZ).process(v), color=DISPLACEMENT)
    named(right, "loops", "command, A", "displacement, µm")
    return figure


def other_operators() -> Figure:
    """Draw loops of models from the literature with a decaying input."""
    figure = Figure(figsize=(6.9, 4.4))
    shapes: dict[str, HysteresisModel] = {
        "Krasnosel'skii-Pokrovskii": KrasnoselskiiPokrovskiiModel(
            lowest=-1.0, spacing=0.25,
            weights=tuple((0.03,) * i + (0.15,) for i in range(9)), command_span=(-1.2, 1.2),
        ),
        "Bouc-Wen": BoucWenModel(
            direct=1.0, hysteretic=0.7, beta=2.5, gamma=1.5, exponent=1, command_span=(-1.2, 1.2)
        ),
        "Duhem": DuhemModel(a=2.5, b=1.0, c=0.7, command_span=(-1.2, 1.2)),
        "generalised PI": GeneralisedModel(
            direct=0.5, weights=(0.4, 0.2), thresholds=(0.1, 0.3), command_span=(-1.2, 1.2),
            rising=PlayEnvelope(slope=1.2, shift=-0.4), falling=PlayEnvelope(slope=1.2, shift=0.1),
        ),
    }  # fmt: skip
    for i, (name, model) in enumerate(shapes.items()):
        axes = figure.add_subplot(2, 2, i + 1)
        v = dying(5, 1.0)
        axes.plot(v, model.forward(RATE_HZ).process(v), color=COLOURS[i])
        named(axes, name, "v", "y")
    return figure


def butterfly() -> Figure:
    """Draw loops of a rod without a bias, and of one confined to one side by a bias."""
    figure, (left, right) = panels(2)
    for axes, bias, amplitude in ((left, 0.0, 1.0), (right, 0.9, 0.6)):
        model = ButterflyModel(
            direct=0.6, weights=(0.2, 0.2), thresholds=(0.1, 0.25), bias=bias,
            shape=DeadbandFunction(
                slope=0.3, up_thresholds=(0.2, 0.5, 0.9), up_weights=(0.9, 0.6, -1.2)
            ),
        )  # fmt: skip
        axes.plot(*steady(model, sine(amplitude)), color=DISPLACEMENT)
        named(axes, f"bias {bias:g}", "command", "displacement")
    return figure


def small_loops(model: HysteresisModel, axes: Axes, colour: str, up: float, small: float) -> None:
    """Draw a rise, then repeated small loops at its end."""
    rise = np.linspace(0.0, up, 400)
    v = np.concatenate((rise, up - small * (1.0 - np.cos(np.linspace(0.0, 12.0 * np.pi, 2400)))))
    axes.plot(v, model.forward(RATE_HZ).process(v), color=colour)


def small_loops_compared() -> Figure:
    """Draw six small loops after a rise: those of plays close immediately, the others creep."""
    figure, (left, middle, right) = panels(3)
    plays = PpiModel(direct=1.0, weights=(0.5, 0.5), thresholds=(0.05, 0.2))
    small_loops(plays, left, COMMAND, 0.6, 0.15)
    named(left, "plays", "command", "displacement")
    field = FieldModel(
        thresholds=(0.0,), lengths=(0.3,), lowest=-1.0, cell=1.0, slopes=((1.0, 1.0), (1.2, 1.2)),
        coupling=0.0, losses=FieldLosses(),
        curve=OutputCurve(operators_um=(-3.0, 0.0, 3.0), displacement_um=(-3.0, 0.0, 3.0)),
    )  # fmt: skip
    small_loops(field, middle, DISPLACEMENT, 0.6, 0.15)
    named(middle, "a play and a drag", "command", "displacement")
    band = GeneralisedDuhemModel(
        lowest_um=-2.0, cell_um=2.0, centre=(-1.0, 0.0, 1.0), flux=(-2.0, 0.0, 2.0),
        half_width=0.6, rising=((0.5, 1.5, 4.0),) * 3, falling=((4.0, 1.5, 0.5),) * 3,
        losses=FieldLosses(),
    )  # fmt: skip
    small_loops(band, right, ERROR, 0.6, 0.15)
    named(right, "slopes by place and direction", "command", "displacement")
    return figure


FIGURES: tuple[Callable[[], Figure], ...] = (
    play_and_stop, plays_and_their_inverse, rate_dependent_plays, deadbands, integrated, stages,
    staged_inverse, preisach, other_operators, butterfly, small_loops_compared,
)  # fmt: skip

if __name__ == "__main__":
    draw_before_and_after(Path(__file__).parent / "pictures" / "before_and_after.png")

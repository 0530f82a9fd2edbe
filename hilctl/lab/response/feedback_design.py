"""Feedback from a measured response: the largest integral gain with its margins, and the open loop.

The response is from the compensator's input to the displacement. It may be measured in closed loop,
because averaging over the periods of a multisine suppresses noise and drift in the loop.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hilctl.base.errors import DataError, InputError
from hilctl.base.files import write_text
from hilctl.base.formatting import quantity, shown_briefly
from hilctl.base.yaml import Document, commented
from hilctl.experiment.file import Experiment
from hilctl.experiment.rig import Exchange
from hilctl.experiment.sections.adaptation import OFFSET_SHARE
from hilctl.experiment.sections.feedback import (
    IntegralFeedbackConfig,
    PiFeedbackConfig,
    bandwidth_of,
    feedback_gains,
    rounded_down,
)
from hilctl.experiment.sections.open_loop import (
    ASSUMED_PHASE_MARGIN_DEG,
    LoopResponse,
    MeasuredResponse,
)
from hilctl.lab.pages import html
from hilctl.lab.pages.figure_layout import FigureSpec, Panel
from hilctl.lab.pages.plot_style import DISPLACEMENT, MARK, REFERENCE, plain_numbers
from hilctl.lab.response.frequency_response import measured_lines
from hilctl.loop.feedback import MOST_GAIN_PER_BLOCK, Gains
from hilctl.models.model_file import model_sha256, parse_model
from hilctl.recording.recording import Recording

_GAINS = {"bandwidth_hz", "kp", "ki_per_s", "resonance_hz", "damping_ratio", "response"}
"""Keys of a recorded feedback that a proposal replaces."""


@dataclass(frozen=True, slots=True)
class LoopMargins:
    """Crossover, margins and peak sensitivity of an open loop."""

    crossover_hz: float  # lowest frequency at which its gain is 1
    gain_margin_db: float
    phase_margin_deg: float
    peak_sensitivity: float  # largest factor by which the loop amplifies a disturbance

    @classmethod
    def of(cls, loop: LoopResponse) -> "LoopMargins":
        """Return the margins of an open loop."""
        crossing = int(np.argmax(loop.size < 1.0))
        sensitivity = 1.0 / np.abs(1.0 + loop.size * np.exp(-1j * loop.lag))
        return cls(float(loop.frequency_hz[crossing]), *loop.margins, float(sensitivity.max()))


@shown_briefly
@dataclass(frozen=True, slots=True)
class FeedbackDesign:
    """Proposed feedback of a run's experiment.

    Attributes:
        feedback: Keys of the proposed ``feedback``.
        proposed: Margins of its open loop.
        recorded: Margins of the feedback of the run; None without one.
    """

    path: Path
    feedback: Mapping[str, Any]
    proposed: LoopMargins
    recorded: LoopMargins | None
    response: MeasuredResponse
    loop: LoopResponse

    def to_yaml(self) -> str:
        """Return the section ``feedback`` of an experiment."""
        return commented({"feedback": self.feedback}, {})

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, as ``hilctl tune --json`` prints them."""
        return {
            "path": str(self.path),
            "feedback": dict(self.feedback),
            "proposed": asdict(self.proposed),
            "recorded": self.recorded and asdict(self.recorded),
            "response": self.response.model_dump(mode="json"),
        }


def design_feedback(recording: Recording, response_file: str | None = None) -> FeedbackDesign:
    """Return the feedback with the largest gain that has its margins on a run's response.

    ``response_file`` is the name of the file for the response, for the key ``response``.

    Raises:
        InputError: The run has no compensator, or its response ends below the lag of 180 degrees.
        DataError: The run has no frequency response above the noise.
    """
    path = recording.path
    if not recording.compensated:
        raise InputError(
            f"{path}: has no compensator: record a multisine through it (waveform.unit um)"
        )
    document = Document(f"{path}: experiment.yaml", recording.experiment_yaml)
    config = document.validate(Experiment, without=("timing",))  # may have keys of earlier releases
    response = _measured(recording)
    latency = int(recording.run.get("latency_blocks", 0))
    exchange = Exchange(config.sample_rate_hz, config.block, latency)
    kind = "pi" if config.block == 1 and not latency else "integral"
    try:
        loop = response.open_loop(Gains(0.0, 1.0), exchange)
        most = MOST_GAIN_PER_BLOCK / config.tick_s if kind == "integral" else math.inf
        ki_per_s = min(loop.room(ASSUMED_PHASE_MARGIN_DEG), most)
        highest_hz = bandwidth_of(kind, ki_per_s, exchange.rate_hz)
        keys = {**_kept(config), "kind": kind, "bandwidth_hz": rounded_down(highest_hz)}
        make = IntegralFeedbackConfig if kind == "integral" else PiFeedbackConfig
        keys |= {"response": response_file} if response_file else {}
        loops = [
            response.open_loop(feedback_gains(each, exchange.rate_hz), exchange)
            for each in (make(**keys), config.feedback)
            if each is not None
        ]
    except InputError as error:
        raise InputError(f"{path}: the response {error}") from None
    proposed, *recorded = map(LoopMargins.of, loops)
    return FeedbackDesign(path, keys, proposed, next(iter(recorded), None), response, loops[0])


def _measured(recording: Recording) -> MeasuredResponse:
    found = measured_lines(recording, "input-displacement")
    if found.response[0].real < 0.0:
        raise DataError(
            f"{recording.path}: the displacement falls when the reference rises: the sign of the "
            "sensor or of the command is wrong"
        )
    model = parse_model(f"{recording.path}: model.yaml", recording.model_yaml)
    return MeasuredResponse(
        sample_rate_hz=recording.sample_rate_hz,
        model_sha256=model_sha256(model),
        frequency_hz=tuple(found.frequency_hz.tolist()),
        gain=tuple(np.abs(found.response).tolist()),
        phase_deg=tuple(np.degrees(np.unwrap(np.angle(found.response))).tolist()),
        provenance={
            "recording": recording.path.name,
            "run_id": recording.run.get("run_id", ""),
        },
    )


def _kept(config: Experiment) -> dict[str, Any]:
    """Return the recorded keys to keep, or the default limit: a tenth of the stroke limits."""
    if (known := config.feedback) is not None:
        return known.model_dump(exclude=_GAINS, exclude_defaults=True)
    low_um, high_um = config.limits.stroke_um
    return {"limit_um": rounded_down(OFFSET_SHARE * (high_um - low_um))}


def margin_rows(design: FeedbackDesign) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return headings and rows of the margins of the proposed and the recorded loop."""
    rows: list[tuple[str, ...]] = [
        (
            name,
            quantity(each.crossover_hz, "Hz"),
            quantity(each.gain_margin_db, "dB"),
            f"{quantity(each.phase_margin_deg)} °",
            quantity(each.peak_sensitivity),
        )
        for name, each in (("proposed", design.proposed), ("recorded", design.recorded))
        if each is not None
    ]
    return ("loop", "crossover", "gain margin", "phase margin", "peak sensitivity"), rows


def open_loop_sheet(design: FeedbackDesign) -> FigureSpec:
    """Return the Bode plot of the open loop, with its margins."""
    hz, lag_deg = design.loop.frequency_hz, np.degrees(design.loop.lag)
    size_db = 20.0 * np.log10(np.maximum(design.loop.size, 1e-300))
    lowest_hz = min(design.response.frequency_hz[0], 0.1 * design.proposed.crossover_hz)
    shown = hz >= lowest_hz
    crossing_hz = design.proposed.crossover_hz
    late_hz = float(hz[np.argmax(np.where(design.loop.lag >= np.pi, design.loop.size, 0.0))])

    def draw(axes: Axes, part: str) -> None:
        values, line, at_hz = (size_db, 0.0, late_hz)
        if part == "phase, °":
            values, line, at_hz = (-lag_deg, -180.0, crossing_hz)
            axes.set(ylim=(-315.0, -45.0), yticks=(-270.0, -180.0, -90.0))
        axes.plot(hz[shown], values[shown], color=DISPLACEMENT)
        axes.axhline(line, color=REFERENCE, linewidth=0.7)
        reached = float(np.interp(at_hz, hz, values))
        axes.plot([at_hz, at_hz], [line, reached], color=MARK, marker="_", label="margin")
        axes.set(xscale="log", xlabel="frequency, Hz", ylabel=part)
        plain_numbers(axes)

    panels = tuple(Panel(partial(draw, part=part)) for part in ("magnitude, dB", "phase, °"))
    found = design.proposed
    caption = (
        f"Open loop of the proposed feedback: gain margin {quantity(found.gain_margin_db, 'dB')}, "
        f"phase margin {quantity(found.phase_margin_deg)} °."
    )
    return FigureSpec("open_loop", caption, panels, stacked=True)


def write_design(design: FeedbackDesign, path: Path) -> None:
    """Write the page of a design; an existing file is replaced."""
    (_, *headings), loops = margin_rows(design)
    tables = [(name, zip(headings, margins, strict=True)) for name, *margins in loops]
    section = html.details("Proposed section of the experiment", design.to_yaml())
    body = [
        html.paragraph(str(design.path), "file"),
        *html.results([open_loop_sheet(design)], "Margins", tables, [section]),
    ]
    write_text(path, html.document("Feedback", body), overwrite=True)

"""Page of a run: complete, self-contained, and without markup from texts."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.report import summarize
from hilctl.base.events import Event
from hilctl.base.segments import Segment
from hilctl.experiment.sections.correction import (
    RESIDUAL,
    Correction,
    LearnedCycle,
    dump_correction,
)
from hilctl.lab.run_report.run_page import (
    headline,
    model_error,
    page,
    provenance_rows,
    run_sheets,
)
from hilctl.models.model_file import load_model
from hilctl.recording.metadata_keys import OVERRIDES_FACT
from hilctl.recording.recording import Recording

NASTY = """<script>alert("x")</script>&amp;<img src=x onerror='y'>"""


class Page(HTMLParser):
    """Tags, references and visible text of a page, as in a browser."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.references: list[str] = []
        self.text = ""
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in {"meta", "img"}:
            self.open.append(tag)
        names = {"src", "href", "data", "action", "srcset", "poster", "background"}
        self.references += [value or "" for name, value in attrs if name in names]
        assert not any(name.startswith("on") for name, _ in attrs)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def recording(make_recording) -> Recording:
    """Return a run of two segments with markup in every text."""
    phase = 2.0 * np.pi * np.arange(8000) / 1000
    lag = np.where(np.arange(8000) < 4000, 0.02, 0.1)
    recording = make_recording(
        40.0 * np.sin(phase - lag),
        reference_um=40.0 * np.sin(phase),
        segments=[
            Segment(f"first {NASTY}", 0, 4000, 0, 4000, 1000.0),
            Segment("second", 4000, 8000, 4000, 8000, 1000.0),
        ],
        run={"name": f"name {NASTY}", "device": f"simulated_{NASTY}", "simulated": "true"},
        end={"reason": f"reason {NASTY}"},
        events=(Event(17, "error", f"code {NASTY}", f"event {NASTY}"),),
        experiment_yaml=f"name: {NASTY}\n",
    )
    return replace(recording, model_yaml=f"model: {NASTY}\n", path=Path(f"{NASTY}.mcap"))


@pytest.fixture(scope="module")
def shown(recording: Recording) -> str:
    """Return the page of that run; to draw it takes seconds."""
    return page(recording, summarize(recording))


@pytest.mark.slow
def test_fetches_nothing(shown: str) -> None:
    seen = Page(shown)
    assert seen.tags.count("svg") == seen.tags.count("figcaption") == 6
    assert all(reference.startswith("#") for reference in seen.references)
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(seen.tags)
    for address in ("http:", "https:", "@import", "xlink"):
        assert address not in shown
    assert all(found.startswith("url(#") for found in re.findall(r"url\(.?", shown))


def test_texts_are_shown_as_they_are(shown: str) -> None:
    seen = Page(shown)
    assert seen.open == []
    for start in ("name ", "first ", "reason ", "code ", "event ", "name: ", "model: "):
        assert start + NASTY in seen.text


def test_holds_figures_segments_events_and_experiment(recording: Recording, shown: str) -> None:
    report = summarize(recording)
    assert headline(report).startswith("Peak hysteresis 9.98 %")
    seen = Page(shown)
    for segment in report.segments:
        assert f"{segment.peak_hysteresis_percent:.4g}"[:4] in seen.text
    assert "noise floor" in seen.text
    assert "no hardware" in seen.text
    assert seen.tags.count("details") == 2
    assert "17" in seen.text


@pytest.mark.usefixtures("undrawn")
def test_cut_short_recording_has_a_page(recording: Recording) -> None:
    empty = replace(recording, samples=recording.samples.part(0, 0), end={}, events=())
    text = Page(page(empty, summarize(empty))).text
    for said in ("not complete", "No steady samples"):
        assert said in text


@pytest.mark.usefixtures("undrawn")
def test_fault_is_shown_once_above_the_figures(recording: Recording) -> None:
    ended = {"code": "fault", "reason": "device gone", "output_safe": "false"}
    events = (Event(100, "error", "lost", "device gone"), Event(120, "error", "more", "no answer"))
    failed = replace(recording, end=ended, events=events)
    text = page(failed, summarize(failed))
    above = text[: text.index("<h2")]
    assert above.count("device gone") == 1
    assert "at 2.000 ms" in above
    assert "2.400 ms: no answer" in above
    assert "NOT confirmed" in above
    assert "hysteresis" not in {sheet.name for sheet in run_sheets(failed, summarize(failed))}


@pytest.mark.parametrize(
    ("label", "period", "shown"),
    [
        ("sine 40 um 50 Hz", 1000.0, {"hysteresis", "steady_cycles"}),
        ("multisine 40 um 50-50 Hz", 1000.0, {"steady_cycles"}),
        ("random 40 um 5-60 Hz seed 1", 0.0, set()),
        ("step", 0.0, {"step_response"}),
        ("path 40 um/s", 0.0, {"hysteresis"}),
    ],
)
def test_a_run_has_the_figures_of_its_waveform(recording, label, period, shown) -> None:
    part = Segment(label, 0, 4000, 0, 4000, period)
    single = replace(recording, segments=(part,))
    report = summarize(single)
    names = {sheet.name for sheet in run_sheets(single, report)}
    assert names == shown | {"error", "error_spectrum", "history", "lateness"}
    known = "hysteresis" in shown and period > 0.0
    assert (report.peak_hysteresis_percent is not None) == known
    assert (report.loop_area is not None) == known
    assert report.peak_error_percent is not None
    assert ("Peak hysteresis" in headline(report)) == known


@pytest.mark.usefixtures("undrawn")
def test_before_and_after_stand_in_one_picture(recording: Recording) -> None:
    before = replace(recording, compensated=False)
    before.samples.command[:] = 5.0 * np.sin(2.0 * np.pi * np.arange(8000) / 1000)
    assert "Before and after" in page(recording, summarize(recording), before)


@pytest.mark.usefixtures("undrawn")
def test_only_the_last_events_are_listed(recording: Recording) -> None:
    many = tuple(Event(k, "warning", "late", f"tick {k}") for k in range(1000))
    text = Page(page(replace(recording, events=many), summarize(recording))).text
    assert "tick 999" in text
    assert "tick 799" not in text
    assert "The first 800" in text


@pytest.mark.usefixtures("undrawn")
def test_largest_numbers_have_no_figure(recording: Recording) -> None:
    """No axis can show them; the text has the metrics."""
    samples = recording.samples
    huge = replace(samples, displacement_um=np.where(samples.index % 2, 1.7e308, -1.7e308))
    changed = replace(recording, samples=huge)
    text = page(changed, summarize(changed))
    assert "No figure" in text
    assert "<figure" not in text


@pytest.mark.slow
def test_control_characters_of_labels_are_escaped(recording: Recording) -> None:
    label = "$\\frac{$ \x1b[31m \u202e" + "x" * 100_000
    named = tuple(replace(segment, label=label) for segment in recording.segments)
    changed = replace(recording, segments=named)
    text = page(changed, summarize(changed))
    assert "\x1b" not in text
    assert "\u202e" not in text


MODEL = Path(__file__).parents[4] / "configs" / "models" / "terfenol_omega.yaml"
RUN = {
    "started": "2026-11-22T14:40:15.891+00:00",
    "device": "serial_dac",
    "simulated": "true",
    "host": "rig-3",
    "waveform.kind": "sine",
    "waveform.unit": "um",
    "waveform.amplitude": "40.8",
    "waveform.offset": "0.0",
    "limits": '{"peak_current_a":7.07}',
    "compensator": "integrated",
    OVERRIDES_FACT: '["waveform.amplitude=40.8"]',
}


@pytest.fixture
def described(make_recording):
    wave = np.sin(np.arange(100.0))
    segment = Segment("sine 40.8 um", 0, 100, 0, 100, 10.0)
    made = make_recording(wave, reference_um=wave, segments=[segment], run=RUN)
    labels = {"operator": "Ada\x1b", "sample": "A7"}
    return replace(made, labels=labels, model_yaml=MODEL.read_text())


def test_provenance_has_date_operator_device_and_settings(described):
    rows = dict(provenance_rows(described))
    assert rows["date"] == "2026-11-22 14:40:15 UTC"
    assert (rows["operator"], rows["sample"]) == ("Ada\\x1b", "A7")
    assert rows["device"].startswith("serial_dac (simulated")
    assert rows["waveform"] == "sine 40.8 um"
    assert rows["waveform settings"] == "amplitude 40.8, unit µm"
    assert rows["limits"] == "peak_current_a 7.07"
    assert rows["overrides"] == "waveform.amplitude=40.8"
    assert rows["model error"] == model_error(load_model(MODEL))


def test_provenance_has_what_learning_gave_up(described):
    zeros = {"reference_um": (0.0,) * 64, "cosine_um": (0.0,), "sine_um": (0.0,)}
    correction = Correction(
        sample_rate_hz=10.0,
        model_sha256="0" * 64,
        cycles=(LearnedCycle(label="sine", period_samples=10.0, **zeros),),
        provenance={RESIDUAL + "sine": "700 Hz: why"},
    )
    changed = replace(described, correction_yaml=dump_correction(correction))
    assert dict(provenance_rows(changed))["given up for sine"] == "700 Hz: why"


def test_a_model_s_error_on_unseen_data_comes_first():
    model = load_model(MODEL)

    def shown_error(**errors):
        known = model.provenance.model_copy(update={"errors_percent": errors})
        return model_error(model.model_copy(update={"provenance": known}))

    fitted = {"peak": 1.0, "rms": 0.5}
    assert shown_error(**fitted).startswith("1.00 % peak, 0.500 % rms, ")
    unseen = shown_error(**fitted, held_out_peak=2.0, held_out_rms=0.7)
    assert unseen.startswith("2.00 % peak, 0.700 % rms, ")


def test_missing_facts_have_no_row(described):
    rows = dict(provenance_rows(replace(described, run={}, labels={}, model_yaml="")))
    assert set(rows) == {"waveform", "compensator"}
    broken = replace(
        described, run=RUN | {"limits": "[", OVERRIDES_FACT: "{"}, model_yaml="kind: x"
    )
    rows = dict(provenance_rows(broken))
    assert "version" in rows["model"]
    assert rows["limits"] == "["

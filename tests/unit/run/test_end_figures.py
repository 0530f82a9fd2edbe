"""Figures gathered sample by sample: those of a report on the whole recording."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.report import summarize
from hilctl.base.events import TUNED, Event
from hilctl.base.samples import Flag
from hilctl.base.segments import Segment
from hilctl.recording.facts import END_FIGURES
from hilctl.recording.reader import read
from hilctl.run.end_figures import EndFigures

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"
TWO = (Segment("a", 0, 3000, 100, 3000, 500.0), Segment("b", 3000, 6000, 3000, 5500, 500.0))
ONCE = (Segment("once", 0, 6000, 1000, 5000),)
FAST = (Segment("too fast for a loop", 0, 6000, 0, 6000, 2.0),)
LONG = (Segment("less than a cycle", 0, 6000, 0, 6000, 9000.0),)


def gathered(recording, pieces=7, events=()):
    """Return the facts that come of a recording's samples, a few at a time."""
    figures = EndFigures(recording.segments, compensated=recording.compensated)
    rows = recording.samples.index.size
    bounds = np.linspace(0, rows, pieces + 1).astype(int)
    for start, stop in pairwise(bounds):
        figures.add(recording.samples.rows(slice(start, stop)))
    for event in events:
        figures.event(event)
    return {name: float(text) for name, text in figures.facts().items()}


def reported(recording):
    """Return the same figures of a report, without those that it has not."""
    report = summarize(recording).to_mapping()
    return {name: report[name] for name in END_FIGURES if report[name] is not None}


@pytest.mark.parametrize("name", ["terfenol_compensated", "terfenol_uncompensated"])
@pytest.mark.parametrize("segments", [(), TWO, ONCE, FAST, LONG])
@pytest.mark.parametrize("pieces", [1, 7, 500])
def test_they_are_those_of_the_report(name, segments, pieces):
    """However the samples come; a gap, a reading that is none and one not trusted do no harm."""
    recording = read(GOLDEN / f"{name}.mcap")
    samples = recording.samples.rows(recording.samples.index % 1000 > 3)
    samples.displacement_um[40::997] = np.nan
    samples.displacement_um[41::997] = 1e9
    samples.flags[41::997] |= Flag.SENSOR_INVALID.value
    chosen = replace(recording, samples=samples, segments=segments or recording.segments)
    found = gathered(chosen, pieces)
    assert found == pytest.approx(reported(chosen), rel=1e-9)
    assert bool(found) == (segments not in (FAST, LONG))


def test_a_segment_that_was_cut_short_has_none():
    """Those before it have: of the second, one sample is missing."""
    recording = replace(read(GOLDEN / "terfenol_compensated.mcap"), segments=TWO)
    cut = replace(recording, samples=recording.samples.part(0, TWO[1].steady_stop - 1))
    first = replace(recording, segments=TWO[:1])
    assert gathered(cut) == pytest.approx(reported(first))
    assert gathered(replace(cut, samples=cut.samples.part(0, 2999))) == {}


@pytest.mark.parametrize(
    ("at", "takes", "counts"), [(50, 50, True), (50, 51, False), (2999, 1, False), (5900, 9, True)]
)
def test_a_segment_that_was_tuned_has_none(at, takes, counts):
    """Where the change ends before its steady part, or begins behind it, the figures count."""
    segments = (Segment("a", 0, 6000, 100, 5000, 500.0),)
    recording = replace(read(GOLDEN / "terfenol_compensated.mcap"), segments=segments)
    change = Event(at, "info", TUNED, "", {"gain": 0.5, "offset": 0.0, "samples": float(takes)})
    assert bool(gathered(recording, events=[change])) == counts


def test_samples_of_the_ramp_are_of_no_segment():
    """A run that is stopped goes on to the safe value, past where its segment would have ended."""
    recording = read(GOLDEN / "terfenol_compensated.mcap")
    samples = recording.samples
    samples.flags[samples.index >= 4000] |= Flag.RAMP.value
    assert gathered(recording) == {}


@pytest.mark.filterwarnings("error")
def test_readings_near_the_end_of_all_numbers_are_read_in_silence():
    recording = read(GOLDEN / "terfenol_compensated.mcap")
    recording.samples.displacement_um[::2] = 1.7e308
    recording.samples.displacement_um[1::2] = -1.7e308
    for segments in (recording.segments, ONCE):
        assert gathered(replace(recording, segments=segments))

"""Rules of the waveform section: line and key of each problem."""

import re
from pathlib import Path

import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.yaml import Document
from hilctl.experiment.load import resolve

EXPERIMENT = """\
name: minimal
device: {{kind: simulated_terfenol}}
sample_rate_hz: 1000
waveform:
{}compensator: none
limits: {{peak_current_a: 2.0, slew_a_per_s: 5000.0, stroke_um: [-75.0, 60.0]}}
"""


def problems(waveform: str) -> list[tuple[str, str]]:
    """Return place and key of each problem of a waveform section that starts in line 5."""
    with pytest.raises(ConfigError) as caught:
        resolve(Document("x.yaml", EXPERIMENT.format(waveform)), Path())
    return [(problem.where, problem.key) for problem in caught.value.problems]


MULTISINE = "kind: multisine, unit: A, amplitude: 1, duration_s: 1"
TRIANGLE = "kind: triangle, unit: A, amplitude: 1, frequency_hz: 10, duration_s: 1"
RANDOM = "kind: random, unit: A, amplitude: 1.0"


@pytest.mark.parametrize(("section", "line", "key"), [
    ("unit: A, kind: sinus, duration_s: 1.0", 6, ".kind"),
    ("unit: A, duration_s: 1.0", 4, ""),
    ("kind: hold, level: 1.0, duration_s: 1.0", 4, ".unit"),
    ("kind: hold, level: 1.0, duration_s: 1.0, unit: V", 8, ".unit"),
    ("kind: step, unit: A, levels: [1], dwell_s: 1, rise_s: 2", 9, ".rise_s"),
    (f"{TRIANGLE}, rise: 0", 10, ".rise"),
    (f"{TRIANGLE}, rise: 1.0", 10, ".rise"),
    ("kind: step, unit: A, levels: [], dwell_s: 1", 7, ".levels"),
    ("kind: step, unit: A, levels: [a, 2.0], dwell_s: 1", 7, ".levels.0"),
    ("kind: step, unit: A, levels: [a], dwell_s: 1", 7, ".levels.0"),
    ("kind: path, unit: A, levels: [], rate_per_s: 2.0", 7, ".levels"),
    ("kind: sequence, unit: A, parts: []", 7, ".parts"),
    ("kind: sequence, unit: A, parts: [{kind: sequence, parts: []}]", 7, ".parts.0.kind"),
    ("kind: complex_harmonic, unit: A, components: [], duration_s: 1", 7, ".components"),
    (f"{MULTISINE}, first_hz: 5, last_hz: 4, step_hz: 1", 10, ".last_hz"),
    (f"{MULTISINE}, first_hz: 0.5, last_hz: 400, step_hz: 0.01", 11, ".step_hz"),
    (f"{MULTISINE}, first_hz: 0.5, last_hz: 400, step_hz: 1.0e-320", 11, ".step_hz"),
    # In half a second there is no whole cycle between 1 and 1.5 Hz.
    (f"{RANDOM}, first_hz: 1.0, last_hz: 1.5, duration_s: 0.5", 10, ".duration_s"),
    ("kind: file, unit: A, path: w.csv, first_row: 5, last_row: 4", 9, ".last_row"),
])  # fmt: skip
def test_broken_rules(section: str, line: int, key: str) -> None:
    """Each key is in a line of its own, the first in line 5."""
    lines = re.sub(r", (?=\w+: )(?![^{]*})", "\n  ", section)
    assert problems(f"  {lines}\n") == [(f"x.yaml:{line}", f"waveform{key}")]


def test_file() -> None:
    found = problems(
        "  kind: file\n  unit: A\n  path: w.csv\n  column: true\n  resample: nearest\n"
        "  first_row: 0\n  last_row: 3.5\n"
    )
    assert sorted(found) == [
        ("x.yaml:10", "waveform.first_row"),
        ("x.yaml:11", "waveform.last_row"),
        ("x.yaml:8", "waveform.column"),
        ("x.yaml:9", "waveform.resample"),
    ]


def test_parts_of_a_sequence() -> None:
    found = problems(
        "  kind: sequence\n"
        "  unit: A\n"
        "  repeat: 10001\n"
        "  parts:\n"
        "    - {kind: hold, level: 1.0, duration_s: 1.0}\n"
        "    - {kind: sine, amplitude: -1, frequency_hz: 10, duration_s: 1}\n"
        "    - {kind: hold, level: 1.0, duration_s: 1.0, levels: 3}\n"
        "    - {kind: growing, amplitude: 1.0, duration_s: 1.0}\n"
        "    - kind: complex_harmonic\n"
        "      duration_s: 1.0\n"
        "      components:\n"
        "        - {amplitude: 1, frequency_hz: 5}\n"
        "        - {amplitude: 1, frequency: 5}\n"
    )
    assert sorted(found) == [
        ("x.yaml:10", "waveform.parts.1.amplitude"),
        ("x.yaml:11", "waveform.parts.2.levels"),
        ("x.yaml:12", "waveform.parts.3.frequency_hz"),
        ("x.yaml:17", "waveform.parts.4.components.1.frequency"),
        ("x.yaml:17", "waveform.parts.4.components.1.frequency_hz"),
        ("x.yaml:7", "waveform.repeat"),
    ]


def test_unit_in_a_part() -> None:
    found = problems(
        "  kind: sequence\n"
        "  unit: A\n"
        "  parts:\n"
        "    - {kind: hold, unit: A, level: 1.0, duration_s: 1.0}\n"
        "    - {kind: hold, unit: um, level: 1.0, duration_s: 1.0}\n"
    )
    assert found == [("x.yaml:9", "waveform.parts")]


def test_a_random_band_has_two_ends_in_order() -> None:
    found = problems(
        "  kind: random\n  unit: A\n  amplitude: 1.0\n  first_hz: 9.0\n  last_hz: 1.5\n"
        "  duration_s: 0.5\n"
    )
    assert ("x.yaml:9", "waveform.last_hz") in found

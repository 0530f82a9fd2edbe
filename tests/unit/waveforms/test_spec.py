"""Rules of the waveform section: line and key of each problem."""

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


def test_unknown_kind() -> None:
    """A kind that there is not is refused with those that there are."""
    found = problems("  unit: A\n  kind: sinus\n  duration_s: 1.0\n")
    assert found == [("x.yaml:6", "waveform.kind")]


def test_no_kind() -> None:
    """Without a kind nothing can be said of the rest."""
    found = problems("  unit: A\n  duration_s: 1.0\n")
    assert found == [("x.yaml:4", "waveform")]


def test_no_unit() -> None:
    """The unit has no default."""
    found = problems("  kind: hold\n  level: 1.0\n  duration_s: 1.0\n")
    assert found == [("x.yaml:4", "waveform.unit")]


def test_unit_of_the_limits() -> None:
    found = problems("  kind: hold\n  level: 1.0\n  duration_s: 1.0\n  unit: V\n")
    assert found == [("x.yaml:8", "waveform.unit")]


def test_rise_longer_than_dwell() -> None:
    found = problems("  kind: step\n  unit: A\n  levels: [1]\n  dwell_s: 1\n  rise_s: 2\n")
    assert found == [("x.yaml:9", "waveform.rise_s")]


@pytest.mark.parametrize(
    ("section", "key"),
    [
        ("  kind: step\n  unit: A\n  levels: []\n  dwell_s: 1\n", "levels"),
        ("  kind: sequence\n  unit: A\n  parts: []\n", "parts"),
        ("  kind: complex_harmonic\n  unit: A\n  components: []\n  duration_s: 1\n", "components"),
    ],
)
def test_empty_list(section: str, key: str) -> None:
    """Levels, parts and components need at least one."""
    found = problems(section)
    assert found == [("x.yaml:7", f"waveform.{key}")]


@pytest.mark.parametrize("value", ["[a, 2.0]", "[a]"])
def test_levels_that_are_no_numbers(value: str) -> None:
    found = problems(f"  kind: step\n  unit: A\n  levels: {value}\n  dwell_s: 1\n")
    assert found == [("x.yaml:7", "waveform.levels.0")]


@pytest.mark.parametrize(
    ("numbers", "key"),
    [
        ("first_hz: 5, last_hz: 4, step_hz: 1", "last_hz"),
        ("first_hz: 0.5, last_hz: 400, step_hz: 0.01", "step_hz"),
        ("first_hz: 0.5, last_hz: 400, step_hz: 1.0e-320", "step_hz"),
    ],
)
def test_multisine(numbers: str, key: str) -> None:
    """A multisine's band must rise, and hold no more sines than anyone can wait for."""
    keys = f"  {{kind: multisine, unit: A, amplitude: 1, duration_s: 1, {numbers}}}\n"
    assert problems(keys) == [("x.yaml:5", f"waveform.{key}")]


def test_file() -> None:
    """Keys of a file waveform are checked like all others."""
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
    rows = "  kind: file\n  unit: A\n  path: w.csv\n  first_row: 5\n  last_row: 4\n"
    assert problems(rows) == [("x.yaml:9", "waveform.last_row")]


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


def test_sequence_in_a_sequence() -> None:
    found = problems("  kind: sequence\n  unit: A\n  parts:\n    - {kind: sequence, parts: []}\n")
    assert found == [("x.yaml:8", "waveform.parts.0.kind")]


def test_a_random_band_must_hold_a_line() -> None:
    """In half a second there is no whole cycle between 1 and 1.5 Hz."""
    found = problems(
        "  kind: random\n  unit: A\n  amplitude: 1.0\n  first_hz: 1.0\n  last_hz: 1.5\n"
        "  duration_s: 0.5\n"
    )
    assert found == [("x.yaml:10", "waveform.duration_s")]


def test_a_random_band_has_two_ends_in_order() -> None:
    found = problems(
        "  kind: random\n  unit: A\n  amplitude: 1.0\n  first_hz: 9.0\n  last_hz: 1.5\n"
        "  duration_s: 0.5\n"
    )
    assert ("x.yaml:9", "waveform.last_hz") in found


def test_a_path_needs_levels() -> None:
    found = problems("  kind: path\n  unit: A\n  levels: []\n  rate_per_s: 2.0\n")
    assert found == [("x.yaml:7", "waveform.levels")]

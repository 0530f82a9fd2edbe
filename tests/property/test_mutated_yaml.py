"""Ten thousand damaged experiments, a thousand damaged profiles: accepted, or refused in words."""

import random
import re
from pathlib import Path

import pytest

from hilctl.base.errors import ConfigError, ConfigProblem, InputError
from hilctl.base.yaml import Document
from hilctl.experiment.load import resolve
from hilctl.experiment.preflight import check
from hilctl_drivers.profile import FOLDER, parse_profile

FILES = 10_000
PARTS = 32
MODEL = """\
model:
  kind: rdpi
  direct: 2.7
  weights: [2.3, 0.4]
  thresholds: [0.3, 0.6]
  output_range_um: [-12.0, 12.0]
"""
GOOD = (
    """\
name: tiny
device: {kind: simulated_terfenol, seed: 1}
sample_rate_hz: 1000
block: 10
waveform: {kind: sine, unit: A, amplitude: 1.0, frequency_hz: 5.0, duration_s: 0.2}
compensator: none
limits: {peak_current_a: 2.0, slew_a_per_s: 500.0, stroke_um: [-75.0, 60.0]}
safe: {value: 0.0, ramp_s: 0.1}
timing: {late_policy: skip, max_late_s: 0.5}
recording: {flush_s: 0.1, ring_s: 2.0}
""",
    """\
name: sweep
device:
  kind: modbus_dac
  profile: labjack_t7
  host: 127.0.0.1
  output: DAC0
  input: AIN0
  amplifier: {gain_a_per_v: 4.0, offset_a: -10.0}
  sensor: {um_per_v: 12.5}
  watchdog: {timeout_s: 2.0}
sample_rate_hz: 200
waveform:
  kind: sequence
  unit: um
  parts:
    - {kind: sine, amplitude: 2.0, frequency_hz: 5.0, duration_s: 0.4, soft_start_s: 0.1}
    - {kind: hold, value: 0.0, duration_s: 0.1}
compensator: {model: model.yaml}
limits: {peak_current_a: 2.0, slew_a_per_s: 500.0, stroke_um: [-75.0, 60.0]}
""",
)
PIECES = (
    "null", "~", "true", "on", "1e3", "1.0e+3", "-1", "0", ".nan", ".inf", "-.inf", "1e999", "''",
    "[]", "{}", "[1, 2]", "*x", "&x 1", "!!python/object:os.system {}", "!!binary aGk=", "<<: *a",
    "? : x", "'", '"', "\t", "\n", "  ", ": ", "- ", "#", "\x00", "\ufeff", "é", "0x1F",
    "2026-11-21", "99999999999999999999", "9" * 400, "none", "...", "---", "%YAML 9.9", "|", ">",
)  # fmt: skip


def mutated(text: str, chance: random.Random) -> str:
    """Return a text with one to four pieces cut, doubled, swapped, or put in."""
    for _ in range(chance.randint(1, 4)):
        a, b = sorted(chance.randrange(len(text) + 1) for _ in range(2))
        b = min(b, a + chance.randint(0, 12))
        lines = text.split("\n")
        how = chance.randrange(6)
        if how == 0:
            text = text[:a] + text[b:]
        elif how == 1:
            text = text[:b] + text[a:]
        elif how == 2:
            text = text[:a] + chance.choice(PIECES) + text[b:]
        elif how == 3:
            i, j = (chance.randrange(len(lines)) for _ in range(2))
            lines[i], lines[j] = lines[j], lines[i]
            text = "\n".join(lines)
        elif how == 4:
            i = chance.randrange(len(lines))
            key, colon, _ = lines[i].partition(":")
            lines[i] = f"{key}{colon} {chance.choice(PIECES)}"
            text = "\n".join(lines)
        else:
            text = text[:a] + chr(chance.randrange(1, 256)) + text[a + 1 :]
    return text


def refusal(text: str, folder: Path) -> InputError | None:
    """Return why an experiment is refused; None where it is not."""
    try:
        check(resolve(Document("experiment.yaml", text), folder))
    except InputError as error:
        return error
    return None


@pytest.mark.parametrize(
    "part", [0, *(pytest.param(part, marks=pytest.mark.slow) for part in range(1, PARTS))]
)
def test_damaged_experiments_are_refused_in_words(tmp_path: Path, part: int) -> None:
    """No crash and no hang; what is refused says where, and nothing is written."""
    (tmp_path / "model.yaml").write_text(MODEL, encoding="utf-8")
    chance = random.Random(part)
    texts = [mutated(GOOD[number % 2], chance) for number in range(FILES // PARTS)]
    refusals = [error for text in texts if (error := refusal(text, tmp_path)) is not None]
    assert len(refusals) > FILES // (2 * PARTS)
    for error in refusals:
        rules = [problem.rule for problem in getattr(error, "problems", ())] or [str(error)]
        assert all(rules), error
    assert [each.name for each in tmp_path.iterdir()] == ["model.yaml"]


@pytest.mark.parametrize("files", [FILES // 160, pytest.param(FILES // 40, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["adam_4024", "adam_4024_ascii", "cobs_board", "labjack_t7"])
def test_damaged_profiles_are_refused_in_words(name: str, files: int) -> None:
    """No crash and no hang; every refusal has a line, a rule, and no word of pydantic's types."""
    good = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    chance = random.Random(name)
    problems: list[ConfigProblem] = []
    for _ in range(files):
        try:
            parse_profile(mutated(good, chance), "profile.yaml")
        except ConfigError as error:
            problems += error.problems
    assert len(problems) > files // 3
    for problem in problems:
        assert re.fullmatch(r"profile\.yaml:\d+", problem.where), problem
        assert problem.rule
        assert not re.search(r"function-|literal\[|tagged-union", problem.key), problem

"""YAML files: scalars of the core schema in every reader; damaged files."""

import math
import random
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from hilctl.base.errors import ConfigError, ConfigProblem, InputError
from hilctl.base.yaml import Document, dump
from hilctl.experiment.load import resolve
from hilctl.experiment.preflight import check
from hilctl.models.model_file import dump_model, load_model, parse_model
from hilctl_drivers.profile import FOLDER, load_profile, parse_profile
from tests.contract.test_bad_input import MODEL as MODEL_TEXT
from tests.unit.experiment.test_file import MINIMAL
from tests.unit.models.test_model_file import OMEGA

INF, NAN = math.inf, math.nan

SCALARS: list[tuple[str, Any]] = [
    ("1", 1), ("+1", 1), ("-1", -1), ("0", 0), ("-0", 0), ("010", 10), ("007", 7), ("089", 89),
    ("0o10", 8), ("0x1F", 31), ("0xfe", 254), ("1e3", 1000.0), ("1E3", 1000.0), ("1e-3", 0.001),
    ("1.0e+3", 1000.0), ("2.5e3", 2500.0), (".5", 0.5), ("-.5", -0.5), ("1.", 1.0), ("+1.5", 1.5),
    ("01.5", 1.5), ("-0.0", -0.0), ("1e999", INF), (".inf", INF), ("-.INF", -INF), ("+.Inf", INF),
    (".nan", NAN), (".NaN", NAN), ("true", True), ("True", True), ("TRUE", True), ("false", False),
    ("null", None), ("Null", None), ("NULL", None), ("~", None), ("", None),
]  # fmt: skip
TEXTS = [
    "yes", "no", "on", "off", "y", "n", "Yes", "OFF", "tRUE", "1:30", "190:20:30", "1_000", "0x_1",
    "0b101", "0o8", "-0x1F", "+0o7", "1,500", "1e", "e3", ".", "+", "1.2.3", "inf", "nan", "+.nan",
    "2026-11-21", "2026-11-21T10:00:00Z", "=", "<<", "none", "0x", "--1", "1e3.5", "\u0661",
]  # fmt: skip


EVERY = [*SCALARS, *((text, text) for text in TEXTS)]


def same(a: Any, b: Any) -> bool:
    """Return whether values have the same type and the same bits."""
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("d", a) == struct.pack("d", b) or (math.isnan(a) and math.isnan(b))
    return type(a) is type(b) and bool(a == b)


@pytest.mark.parametrize(("text", "value"), EVERY)
def test_scalars_are_those_of_the_core_schema(text, value):
    """Numbers, booleans and nothing as YAML 1.2 has them; quotes make any of them text."""
    data = Document("x.yaml", f"bare: {text}\nlist:\n- {text}\nquoted: '{text}'\n").data
    assert same(data["bare"], value)
    assert same(data["list"][0], value)
    assert data["quoted"] == text


EXPERIMENT = (
    MINIMAL
    + """\
description: DESCRIPTION
safe:
  ramp_s: NUMBER
"""
)
MODEL = """\
model:
  kind: rdpi
  direct: 2.7
  weights: [2.3]
  thresholds: [0.3]
  output_offset_um: NUMBER
  provenance:
    method: DESCRIPTION
"""
PROFILE = (FOLDER / "generic_float32.yaml").read_text(encoding="utf-8")
PROFILE = PROFILE.replace("vendor: ", "vendor: DESCRIPTION  # ", 1)
PROFILE = "\n".join(
    "max_rate_hz: NUMBER" if line.startswith("max_rate_hz:") else line
    for line in PROFILE.splitlines()
)


def read_experiment(text: str) -> tuple[Any, Any]:
    config = resolve(Document("x.yaml", text), Path()).config
    return config.description, config.safe.ramp_s


def read_model(text: str) -> tuple[Any, Any]:
    model = parse_model("x.yaml", text)
    return model.provenance.method, model.output_offset_um


def read_profile(text: str) -> tuple[Any, Any]:
    profile = parse_profile(text, "x.yaml")
    return profile.vendor, profile.max_rate_hz


def outcome(read: Callable[[str], Any], text: str) -> Any:
    try:
        return read(text)
    except ConfigError as error:
        return error


READERS = [(read_experiment, EXPERIMENT), (read_model, MODEL), (read_profile, PROFILE)]


@pytest.mark.slow
@pytest.mark.parametrize(("read", "template"), READERS)
@pytest.mark.parametrize(("text", "value"), EVERY)
def test_every_reader_reads_the_same(read, template, text, value):
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    for place, filler, wanted in (("DESCRIPTION", "1.0", str), ("NUMBER", "words", float)):
        other = {"DESCRIPTION": "NUMBER", "NUMBER": "DESCRIPTION"}[place]
        full = template.replace(place, text).replace(other, filler)
        line = next(i for i, row in enumerate(template.splitlines(), 1) if place in row)
        fits = isinstance(value, str) if wanted is str else is_number
        found = outcome(read, full)
        if isinstance(found, ConfigError):
            assert not fits or not math.isfinite(value) or value <= 0.0
            assert [each.where for each in found.problems] == [f"x.yaml:{line}"]
        else:
            assert fits
            assert found[0 if wanted is str else 1] == value


@pytest.mark.parametrize(("read", "template"), READERS)
@pytest.mark.parametrize(("number", "reason"), [
    ("*x", "aliases"), ("!!float 1", "tags"), ("{? [1] : 2}", "a key must be text"),
    ("[" * 40, "nested more than 32"), ('"\\ud800"', "half a character"), ("[1", "expected"),
    ("\x07", "U+0007"),
])  # fmt: skip
def test_every_reader_refuses_the_same(read, template, number, reason):
    text = template.replace("NUMBER", number).replace("DESCRIPTION", "words")
    with pytest.raises(ConfigError) as caught:
        read(text)
    (problem,) = caught.value.problems
    assert problem.where.startswith("x.yaml:")
    assert int(problem.where.removeprefix("x.yaml:")) > 1
    assert problem.rule.startswith("is not readable")
    assert reason in problem.hint


@pytest.mark.parametrize("load", [load_model, lambda path: load_profile(str(path))])
def test_files_that_can_not_be_read_are_refused_alike(load, tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(Exception, match=r"x\.yaml: .*UTF-8"):
        load(path)


TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=200)
LOOKALIKE = st.from_regex(r"[-+]?[0-9._:,eExXoOabfin]{0,12}", fullmatch=True)
SCALAR = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), TEXT, LOOKALIKE,
    st.sampled_from(TEXTS), st.sampled_from([text for text, _ in SCALARS]),
)  # fmt: skip
DATA = st.dictionaries(
    st.one_of(TEXT, LOOKALIKE),
    st.recursive(
        SCALAR,
        lambda inner: st.one_of(
            st.lists(inner, max_size=4).map(tuple), st.dictionaries(TEXT, inner, max_size=4)
        ),
        max_leaves=12,
    ),
    max_size=5,
)


def alike(a: Any, b: Any) -> bool:
    """Return whether nested data are the same, order, types and bits included."""
    if isinstance(a, dict) and isinstance(b, dict):
        return list(a) == list(b) and all(alike(a[key], b[key]) for key in a)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(alike, a, b))
    return same(a, b)


@given(DATA)
def test_what_is_dumped_reads_back_the_same(data):
    assert alike(Document("x.yaml", dump(data)).data, data)


@given(st.one_of(TEXT, LOOKALIKE, st.floats(allow_nan=False), st.integers(-(2**63), 2**64 - 1)))
def test_other_programs_read_what_is_dumped(value):
    """A reader of YAML 1.1 finds the same scalar: what it would take for another is quoted."""
    assert same(yaml.safe_load(dump({"a": value}))["a"], value)


def test_dumped_lists_that_are_one_object_stand_twice():
    """No aliases are written: they would be refused on reading."""
    weights = (0.5, 0.25)
    text = dump({"a": weights, "b": weights, "c": [weights]})
    assert Document("x.yaml", text).data == {"a": weights, "b": weights, "c": (weights,)}


def test_dumped_text_is_as_people_write_it():
    data = {"a": "words", "b": "on", "c": "1e3", "d": "0o10", "e": 1e-05, "f": 1e22, "g": "1:30"}
    assert dump(data) == (
        "a: words\nb: 'on'\nc: '1e3'\nd: '0o10'\ne: 1.0e-05\nf: 1.0e+22\ng: '1:30'\n"
    )


@pytest.mark.parametrize(("text", "rule"), [
    ("a: " + "x" * 3_000_000, "3000003 characters, more than the 2000000 that are read"),
    ("a: [" + "1," * 600 + "]", "more than the 500 values that are read"),
    ("a: &x [1]\nb: [" + "*x," * 9 + "]", "aliases"),
])  # fmt: skip
def test_too_much_is_refused_at_once(text, rule, monkeypatch):
    monkeypatch.setattr("hilctl.base.yaml.MAX_VALUES", 500)
    with pytest.raises(ConfigError, match=rule):
        Document("large.yaml", text)


FILES = 10_000
PARTS = 32
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
timing: {max_missed_share: 1, max_late_s: 0.5}
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
MODELS = (MODEL_TEXT, dump_model(OMEGA))
PIECES = (
    "null", "~", "true", "on", "1e3", "1.0e+3", "-1", "0", ".nan", ".inf", "-.inf", "1e999", "''",
    "[]", "{}", "[1, 2]", "*x", "&x 1", "!!python/object:os.system {}", "!!binary aGk=", "<<: *a",
    "? : x", "'", '"', "\t", "\n", "  ", ": ", "- ", "#", "\x00", "\ufeff", "é", "0x1F",
    "2026-11-21", "99999999999999999999", "9" * 400, "none", "...", "---", "%YAML 9.9", "|", ">",
)  # fmt: skip
NASTY = (
    *PIECES, "!!int ", "!!set ", "!<tag:yaml.org,2002:int> ", "<<: ", "? [1]\n", ",", "%YAML 1.1\n",
    "\x85", "\u2028", "\ud800", '"\\U99999999"', '"\\ud800"', '"\\x00"', "0x" + "f" * 5000,
    "9" * 5000, "2024-13-99", "0b_", "1:30", "5.0e-324", "1.0e+308", "[" * 3000, "{a: " * 3000,
    "- " * 500, "kind: [1]\n", "kind: {a: 1}\n", "kind: ppi\n", "model: &m\n  x: *m\n", "1: 2\n",
    "[a]: 2\n", "{a: b}: 2\n",
)  # fmt: skip


def mutated(text: str, chance: random.Random, pieces: tuple[str, ...] = PIECES) -> str:
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
            text = text[:a] + chance.choice(pieces) + text[b:]
        elif how == 3:
            i, j = (chance.randrange(len(lines)) for _ in range(2))
            lines[i], lines[j] = lines[j], lines[i]
            text = "\n".join(lines)
        elif how == 4:
            i = chance.randrange(len(lines))
            key, colon, _ = lines[i].partition(":")
            lines[i] = f"{key}{colon} {chance.choice(pieces)}"
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


@pytest.mark.parametrize("part", [
    0,
    *(pytest.param(part, marks=pytest.mark.slow) for part in range(1, 8)),
    *(pytest.param(part, marks=[pytest.mark.slow, pytest.mark.long]) for part in range(8, PARTS)),
])  # fmt: skip
def test_damaged_experiments_are_refused_in_words(tmp_path, part):
    (tmp_path / "model.yaml").write_text(MODEL_TEXT, encoding="utf-8")
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
def test_damaged_profiles_are_refused_in_words(name, files):
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


@pytest.mark.parametrize("files", [200, pytest.param(2_000, marks=pytest.mark.slow)])
def test_damaged_models_are_refused_in_words(files):
    refusals = []
    for seed in range(files):
        chance = random.Random(seed)
        text = mutated(chance.choice(MODELS), chance, NASTY)
        try:
            parse_model("m.yaml", text)
        except InputError as error:
            refusals.append(str(error))
    assert len(refusals) > 0.75 * files
    assert all(text.startswith("m.yaml") for text in refusals)
    assert "\n".join(refusals).encode("utf-8")

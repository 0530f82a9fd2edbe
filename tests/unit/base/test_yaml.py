"""Documents: values with their places, settings from the command line, problems."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import pytest
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from hilctl.base.errors import ConfigError, InputError
from hilctl.base.strict import StrictModel
from hilctl.base.yaml import Document, commented, dotted, load_document, loc_of, texts_of

TEXT = """\
name: bench
limits:
  peak_a: 6.0
  steps: [1, 2, 3]
parts:
  - kind: round
    radius_um: 2.5
  - kind: square
    side_um: 4.0
"""


class Strict(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


class Round(Strict):
    kind: Literal["round"] = "round"
    radius_um: float = Field(gt=0.0, lt=10.0)


class Square(Strict):
    kind: Literal["square"] = "square"
    side_um: float = Field(ge=0.0, le=10.0)
    square: float = 0.0


class Limits(Strict):
    peak_a: float
    steps: tuple[int, ...] = Field(default=(), min_length=1, max_length=3)
    slow: bool = False


class SetUp(Strict):
    name: str
    limits: Limits
    parts: tuple[Annotated[Round | Square, Field(discriminator="kind")], ...] = ()
    colours: dict[str, float] = Field(default_factory=dict)


def document(text=TEXT):
    return Document("bench.yaml", text)


def problems(text, **settings):
    with pytest.raises(ConfigError) as caught:
        document(text).validate(SetUp, **settings)
    return str(caught.value).split("\n")


def places(error):
    """Return the place and the key of each problem."""
    return [f"{each.where}: {each.key}" for each in error.problems]


def refusal(action, *arguments):
    with pytest.raises(ConfigError) as caught:
        action(*arguments)
    return str(caught.value)


def changed(before, after):
    assert before in TEXT
    return TEXT.replace(before, after)


def test_a_good_document_becomes_a_model():
    bench = document().validate(SetUp)
    assert bench.limits == Limits(peak_a=6.0, steps=(1, 2, 3))
    assert bench.parts == (Round(radius_um=2.5), Square(side_um=4.0))


@pytest.mark.parametrize(("loc", "place"), [
    (("name",), 1), (("limits",), 2), (("limits", "peak_a"), 3), (("limits", "steps", 1), 4),
    (("parts", 1, "side_um"), 9), (("parts", 1, "missing"), 8), (("nowhere", "at", "all"), 1),
])  # fmt: skip
def test_every_value_has_its_line(loc, place):
    assert document().where(loc) == f"bench.yaml:{place}"


@pytest.mark.parametrize(("before", "after", "place", "value", "part"), [
    ("6.0", "'6.0'", "3: limits.peak_a", "'6.0'", "quotes"),
    ("6.0", "'1e3'", "3: limits.peak_a", "'1e3'", "quotes"),
    ("6.0", "1,500", "3: limits.peak_a", "'1,500'", "1.500 or 1500"),
    ("6.0", "1_000", "3: limits.peak_a", "'1_000'", "plain number"),
    ("6.0", "1:30", "3: limits.peak_a", "'1:30'", "plain number"),
    ("6.0", "on", "3: limits.peak_a", "'on'", "number"),
    ("6.0", "six", "3: limits.peak_a", "'six'", "number"),
    ("6.0", "nan", "3: limits.peak_a", "'nan'", "number"),
    ("6.0", "1e999", "3: limits.peak_a", "inf", "finite"),
    ("6.0", ".nan", "3: limits.peak_a", "nan", "finite"),
    ("6.0", "-.inf", "3: limits.peak_a", "-inf", "finite"),
    ("6.0", "1.0e+999", "3: limits.peak_a", "inf", "finite"),
    ("6.0", "2024-01-01", "3: limits.peak_a", "'2024-01-01'", "plain number"),
    ("6.0", "", "3: limits.peak_a", "nothing", "number"),
    ("[1, 2, 3]", "[1, 2.5]", "4: limits.steps.1", "2.5", "whole"),
    ("[1, 2, 3]", "[]", "4: limits.steps", "[]", "at least 1"),
    ("[1, 2, 3]", "[1, 2, 3, 4]", "4: limits.steps", "[1, 2, 3, 4]", "at most 3"),
    ("[1, 2, 3]", "7", "4: limits.steps", "7", "list"),
    ("[1, 2, 3]", "[1000.5]", "4: limits.steps.0", "1000.5", "whole"),
    ("bench", "true", "1: name", "true", "quotes"),
    ("bench", "5", "1: name", "5", "quotes"),
    ("  peak_a", "  slow: on\n  peak_a", "3: limits.slow", "'on'", "true or false"),
    ("  peak_a: 6.0\n", "", "2: limits.peak_a", "", "required"),
    ("peak_a", "peek_a", "3: limits.peek_a", "", "'peak_a'"),
    ("peak_a", "zzz", "3: limits.zzz", "", "peak_a, slow, steps"),
    ("2.5", "0.0", "7: parts.0.radius_um", "0.0", "> 0.0"),
    ("2.5", "10.0", "7: parts.0.radius_um", "10.0", "< 10.0"),
    ("4.0", "-1", "9: parts.1.side_um", "-1", ">= 0.0"),
    ("4.0", "11", "9: parts.1.side_um", "11", "<= 10.0"),
    ("side_um", "square: 1.0\n    sid_um", "10: parts.1.sid_um", "", "'side_um'"),
    ("radius_um: 2.5", "round: 2.5", "7: parts.0.round", "", "kind, radius_um"),
    ("kind: square", "kind: sqare", "8: parts.1.kind", "'sqare'", "'square'"),
    ("kind: square\n    ", "", "8: parts.1", "", "round, square"),
    ("parts:", "colours: {red: x}\nparts:", "5: colours.red", "'x'", "number"),
])  # fmt: skip
def test_problem_has_place_value_and_rule(before, after, place, value, part):
    with pytest.raises(ConfigError) as caught:
        document(changed(before, after)).validate(SetUp)
    found = {f"{each.where}: {each.key}": each for each in caught.value.problems}
    problem = found[f"bench.yaml:{place}"]
    assert problem.value == value
    assert part in f"{problem.rule} {problem.hint}"


def test_all_problems_come_together():
    text = changed("bench", "7").replace("6.0", "x").replace("2.5", "-1").replace("4.0", "y")
    assert [line.split(": ")[:2] for line in problems(text)] == [
        ["bench.yaml:1", "name"],
        ["bench.yaml:3", "limits.peak_a"],
        ["bench.yaml:7", "parts.0.radius_um"],
        ["bench.yaml:9", "parts.1.side_um"],
    ]


def test_part_of_a_document():
    first = ("parts", 0)
    assert document().validate(Round, at=first).radius_um == 2.5
    with pytest.raises(ConfigError, match=r"bench\.yaml:6: parts\.0\.kind: "):
        document().validate(Limits, at=first)
    with pytest.raises(ConfigError) as caught:
        document().validate(Limits, at=first, without=("kind",))
    assert places(caught.value) == [
        "bench.yaml:6: parts.0.peak_a",
        "bench.yaml:7: parts.0.radius_um",
    ]


def test_context_reaches_the_validators():

    class Named(Strict):
        name: str

        @field_validator("name")
        @classmethod
        def _known(cls, name, info):
            if name not in info.context["names"]:
                raise ValueError("must be known")
            return name

    one = document("name: bench\n")
    assert one.validate(Named, context={"names": ["bench"]}).name == "bench"
    with pytest.raises(ConfigError, match=r"bench\.yaml:1: name: "):
        one.validate(Named, context={"names": []})


def test_long_values_are_cut():
    (line,) = problems(changed("6.0", "x" * 500))
    assert len(line) < 120
    assert line.endswith("...")


def test_duplicate_keys_are_all_named():
    text = changed("peak_a: 6.0", "peak_a: 6.0\n  peak_a: 7.0") + "name: again\n"
    with pytest.raises(ConfigError) as caught:
        document(text)
    assert places(caught.value) == ["bench.yaml:4: limits.peak_a", "bench.yaml:11: name"]


@pytest.mark.parametrize(("text", "message"), [
    ("", "bench.yaml:1: must hold a mapping of keys to values"),
    ("- 1\n", "bench.yaml:1: must hold a mapping of keys to values"),
    ("a: 1\nb: [1\n", "bench.yaml:3: is not readable YAML"),
    ("a: 1\n\tb: 2\n", "bench.yaml:2: is not readable YAML"),
    ("a: 1\n---\nb: 2\n", "bench.yaml:2: is not readable YAML (but found another document)"),
    ("a: \0\n", "bench.yaml:1: is not readable YAML (the character U+0000 is not"),
    ("a: &x 1\nb: *x\n", "bench.yaml:2: is not readable YAML (aliases"),
    ("a: &x\n  b: *x\n", "bench.yaml:2: is not readable YAML (aliases"),
    ("a: {<<: *x}\n", "bench.yaml:1: is not readable YAML (aliases"),
    ("a: 1\nb: !!float 1\n", "bench.yaml:2: is not readable YAML (tags"),
    ("a: 1\nb: !!python/name:os.system x\n", "bench.yaml:2: is not readable YAML (tags"),
    ("!!set {a, b}\n", "bench.yaml:1: is not readable YAML (tags"),
    ("a: 1\n? [b]\n: 2\n", "bench.yaml:2: is not readable YAML (a key must be text)"),
    ("a: 1\n{b: c}: 2\n", "bench.yaml:2: is not readable YAML (a key must be text)"),
    pytest.param("a: " + 9_000 * "{b: ",
                 "bench.yaml:1: is not readable YAML (nested more than 32 deep)", id="9000 deep"),
    ("a: " + 40 * "[", "bench.yaml:1: is not readable YAML (nested more than 32 deep)"),
    ('a: "\\ud800"\n', "bench.yaml:1: is not readable YAML (contains half a character"),
    ('a: "\\U99999999"\n', "bench.yaml:1: is not readable YAML (an escape names"),
    ('a: 1\nb: "\\U7fffffff"\n', "bench.yaml:2: is not readable YAML (an escape names"),
    ("a: 1\nb: 2\nc: \x07\n", "bench.yaml:3: is not readable YAML (the character U+0007 is not"),
])  # fmt: skip
def test_other_than_plain_yaml_is_refused(text, message):
    assert refusal(document, text).startswith(message)


def test_nesting_up_to_the_limit_is_read():
    value = document("a: " + 31 * "[" + "1" + 31 * "]").data["a"]
    for _ in range(31):
        (value,) = value
    assert value == 1


@pytest.mark.parametrize(("text", "value"), [
    ("2024-01-01", "2024-01-01"), ("2024-01-01T10:00:00Z", "2024-01-01T10:00:00Z"),
    ("2024-13-99", "2024-13-99"), ("0x_", "0x_"), ("=", "="), ("<<", "<<"),
    ("0x" + "f" * 32, float(0x10**32)), ("18446744073709551615", 2**64 - 1), ("1_000", "1_000"),
    pytest.param("9" * 5_000, float("inf"), id="5000 digits"),
    pytest.param("-" + "9" * 5_000, float("-inf"), id="minus and 5000 digits"),
    pytest.param("1" + "0" * 400, float("inf"), id="400 digits"),
])  # fmt: skip
def test_odd_scalars_become_text_or_numbers(text, value):
    read = document(f"a: {text}\n").data["a"]
    assert read == value
    assert type(read) is type(value)


def test_keys_are_text():
    assert document("1: a\nnull: b\ntrue: c\n2024-01-01: d\n").data == {
        "1": "a", "null": "b", "true": "c", "2024-01-01": "d",
    }  # fmt: skip


@pytest.mark.parametrize(("assignment", "loc", "value"), [
    ("name=other", ("name",), "other"),
    ("limits.peak_a=2", ("limits", "peak_a"), 2),
    ("limits.peak_a=1e-3", ("limits", "peak_a"), 0.001),
    ("name=on", ("name",), "on"),
    ("limits.peak_a = 2.5", ("limits", "peak_a"), 2.5),
    ("limits.slow=true", ("limits", "slow"), True),
    ("limits.steps=[4, 5]", ("limits", "steps"), (4, 5)),
    ("limits.steps.2=9", ("limits", "steps"), (1, 2, 9)),
    ("limits={peak_a: 1.0}", ("limits",), {"peak_a": 1.0}),
    ("parts.1.side_um=7.5", ("parts", 1), {"kind": "square", "side_um": 7.5}),
    ("colours.red=1.0", ("colours",), {"red": 1.0}),
    ("name=", ("name",), None),
    ("name=a=b", ("name",), "a=b"),
])  # fmt: skip
def test_set_changes_one_place(assignment, loc, value):
    changed_document, data = document(), document().data
    changed_document.set(assignment)
    found = changed_document.data
    for part in loc:
        found = found[part]
    assert found == value
    others = {key: data[key] for key in data if key != loc[0]}
    assert {key: changed_document.data[key] for key in others} == others


def test_a_section_that_is_none_becomes_a_mapping():
    document = Document("x.yaml", "a: none\nb: 1.0")
    document.set("a.kind=integral")
    document.set("a.gain=2.0")
    assert document.data == {"a": {"kind": "integral", "gain": 2.0}, "b": 1.0}


def test_problems_of_a_setting_point_to_it():
    one = document()
    for assignment in ("limits.peak_a=1_0", "parts.0={kind: round, radius: 1.0}", "colors.red=1"):
        one.set(assignment)
    with pytest.raises(ConfigError) as caught:
        one.validate(SetUp)
    part = "setting parts.0={kind: round, radius: 1.0}"
    assert places(caught.value) == [
        "setting limits.peak_a=1_0: limits.peak_a",
        f"{part}: parts.0.radius_um",
        f"{part}: parts.0.radius",
        "setting colors.red=1: colors",
    ]


def test_a_setting_forgets_the_places_it_replaces():
    one = document()
    one.set("parts=[{kind: round, radius_um: 1.0}]")
    assert one.where(("parts", 0, "radius_um")).startswith("setting parts=")
    assert one.where(("parts", 1, "side_um")).startswith("setting parts=")
    assert one.where(("limits", "peak_a")) == "bench.yaml:3"


@pytest.mark.parametrize(("assignment", "message"), [
    ("name", "setting name: must be dotted.key=value"),
    ("=5", "setting =5: must be dotted.key=value"),
    ("limits..peak_a=5", "setting limits..peak_a=5: must be dotted.key=value"),
    (".".join("a" * 40) + "=1", "setting a.a"),
    ("name.first=5", "setting name.first=5: name.first: there is no such key to set"),
    ("limits.peak_a.x=5", "setting limits.peak_a.x=5: limits.peak_a.x: there is no such key"),
    ("limits.steps.3=5", "setting limits.steps.3=5: limits.steps.3: there is no such key to set"),
    ("limits.steps.-1=5", "setting limits.steps.-1=5: limits.steps.-1: there is no such key"),
    ("limits.steps.²=5", "setting limits.steps.²=5: limits.steps.²: there is no such key"),
    ("parts.one.side_um=5", "setting parts.one.side_um=5: parts.one: there is no such key to set"),
    ("name=[1", "setting name=[1: name: is not readable YAML, got '[1' ("),
    ("name=*x", "setting name=*x: name: is not readable YAML, got '*x' (aliases"),
    ("name=!!int 5", "setting name=!!int 5: name: is not readable YAML, got '!!int 5' (tags"),
    ('name="\\U99999999"', 'setting name="\\U99999999": name: is not readable YAML'),
    ("limits={peak_a: 1, peak_a: 2}",
     "setting limits={peak_a: 1, peak_a: 2}: limits.peak_a: stands twice"),
])  # fmt: skip
def test_settings_that_cannot_be_made(assignment, message):
    assert refusal(document().set, assignment).startswith(message)


def test_files_are_read_or_refused(tmp_path):
    path = tmp_path / "bench.yaml"
    path.write_text(TEXT, encoding="utf-8")
    assert load_document(path).where(("limits", "peak_a")) == f"{path}:3"
    for bad, message in [
        (tmp_path / "none.yaml", "no such file"),
        (tmp_path, "is not a file"),
        (tmp_path / "a\0b", "cannot be read: .*embedded null"),
    ]:
        with pytest.raises(InputError, match=message):
            load_document(bad)
    path.write_bytes(b"\xff\xfe\xfd")
    with pytest.raises(InputError, match="is not UTF-8 text"):
        load_document(path)


TREE = {
    "name": "sine",
    "on": "yes",
    "device": {"kind": "a: b", "gain": -2.5, "none": None, "deep": {"x": 1, "list": [1.0, 2.0]}},
    "limits": {"drive_v": [0.0, 20.0]},
    "empty": {},
    "long": "a word and another " * 8,
}


def test_commented_text_is_read_back():
    text = commented(TREE, {"device": "above", "device.gain": "behind", "long": "before"})
    read = Document("f.yaml", text).data
    assert read == {**TREE, "device": {**TREE["device"], "deep": {"x": 1, "list": (1.0, 2.0)}},
                    "limits": {"drive_v": (0.0, 20.0)}}  # fmt: skip


def test_each_comment_is_beside_its_value():
    comments = {"device": "all of it", "device.gain": "A/V", "limits.drive_v": "low, high"}
    lines = commented(TREE, comments).splitlines()
    assert "device:  # all of it" in lines
    assert "  gain: -2.5  # A/V" in lines
    assert "  drive_v: [0.0, 20.0]  # low, high" in lines
    assert sum("#" in line for line in lines) == len(comments)


def test_comment_of_a_long_text_is_above_it():
    lines = commented(TREE, {"long": "what it is for"}).splitlines()
    assert lines[lines.index("# what it is for") + 1].startswith("long: 'a word")


class Guard(StrictModel):
    timeout_s: float
    kick: Literal["any", "write"] = "any"

    @model_validator(mode="after")
    def _not_both(self) -> "Guard":
        if self.timeout_s > 1.0 and self.kick == "any":
            raise ValueError("kick must be write where timeout_s is above 1")
        return self


class Sine(StrictModel):
    kind: Literal["sine"]
    height: float


class Step(StrictModel):
    kind: Literal["step"]


Checked = AfterValidator(lambda value: value)


class Several(StrictModel):
    guard: Guard | Literal["none"] = "none"
    base: Literal[0, 1, "modicon"] | None = None
    end: Literal["\r", "\n"] = "\n"
    level: float | Literal["safe"] = 0.0
    guards: Mapping[str, Guard | Literal["none"]] = Field(default_factory=dict)
    wave: Annotated[Annotated[Sine | Step, Field(discriminator="kind")], Checked] | None = None
    span: tuple[float, Annotated[int, Field(ge=0)]] = (0.0, 0)
    names: dict[Annotated[str, Field(pattern="^[a-z]+$")], float] = Field(default_factory=dict)


@pytest.mark.parametrize(("text", "problems"), [
    ("guard: off", ["x:1: guard: must be a mapping of keys to values, or 'none', got 'off'"]),
    ("guard: [1]", ["x:1: guard: must be a mapping of keys to values, or 'none', got [1]"]),
    ("guard:\n  timeout: 1",
     ["x:1: guard.timeout_s: is required",
      "x:2: guard.timeout: unknown key (did you mean 'timeout_s'?)"]),
    ("guard:\n  timeout_s: 2\n  kick: any",
     ["x:3: guard: kick must be write where timeout_s is above 1"]),
    ("guard:\n  timeout_s: 2",
     ["x:1: guard: kick must be write where timeout_s is above 1"]),
    ("guard: {timeout_s: 2, kick: x}",
     ["x:1: guard.kick: must be one of 'any' or 'write', got 'x'"]),
    ("guard: {timeout_s: 2, kick: wirte}",
     ["x:1: guard.kick: must be one of 'any' or 'write', got 'wirte' (did you mean 'write'?)"]),
    (r"end: '\n'",
     [r"x:1: end: must be one of '\r' or '\n', got '\\n'" r' (write it in double quotes: "\n")']),
    ("base: 2", ["x:1: base: must be one of 0, 1 or 'modicon', got 2"]),
    ("level: high", ["x:1: level: must be a number, or 'safe', got 'high'"]),
    ("level: '1e3'", ["x:1: level: must be a number, or 'safe', got '1e3' (remove the quotes)"]),
    ("level: .nan", ["x:1: level: must be a finite number, got nan"]),
    ("guards:\n  a: {timeout_s: x}\n  b: off",
     ["x:2: guards.a.timeout_s: must be a number, got 'x'",
      "x:3: guards.b: must be a mapping of keys to values, or 'none', got 'off'"]),
    ("span: [x, -1]",
     ["x:1: span.0: must be a number, got 'x'",
      "x:1: span.1: must be >= 0, got -1"]),
    ("wave: {kind: sine}", ["x:1: wave.height: is required"]),
    ("names: {A1: 1.0}",
     ["x:1: names.A1: must match the pattern ^[a-z]+$, got 'A1'"]),
])  # fmt: skip
def test_problems_of_union_types(text: str, problems: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        Document("x", text).validate(Several)
    assert [str(each) for each in caught.value.problems] == problems


def test_keys_and_suggestions() -> None:
    assert dotted(("a", 0, "b")) == "a.0.b"
    assert loc_of("a.0.b") == ("a", 0, "b")
    assert loc_of("a.².b") == ("a", "²", "b")


class Wave(StrictModel):
    REMOVED: ClassVar = {"heights_um": "removed: set height_um"}

    unit: Literal["um", "A"] = "um"
    height_um: float = 0.0
    cycles: int = 1
    either: float | Literal["safe"] = 0.0
    span: tuple[float, float] = (0.0, 1.0)
    name: str = ""


class Whole(StrictModel):
    wave: Wave = Wave()


def read(text, **more):
    document = Document("x.yaml", text)
    return document, document.validate(Whole, **more).wave


@pytest.mark.parametrize(("text", "said"), [
    ("height_um: 1,5", "1.5 or 15?"),
    ("height_um: 1,500", "1.500 or 1500?"),
    ("cycles: 1e3", "write 1000"),
    ("height_um: 1,5,2", "must be a number"),
    ("height_um: 1.5,2", "must be a number"),
    ("height_um: µ", "must be a number"),
    ("height_um: \N{MINUS SIGN}5.0", "MINUS SIGN"),
    ("height_um: 1.0\n\N{NO-BREAK SPACE} unit: A\n  cycles: 1", "invisible character U.00A0"),
    ("either: 1,5", "must be a number, or 'safe'"),
    ("span: [1,5, 2]", "must have at most 2 values"),
    ("cycles: 1.5", "must be a whole number"),
    ("cycles: 1e300", "must be a whole number"),
    ("unit: µm", "must be one of 'um' or 'A', got 'µm'"),
    ("height_µm: 2.0", r"unknown key \(did you mean 'height_um'\?\)"),
    ("heights_um: 2.0", r"heights_um: unknown key \(removed: set height_um\)"),
])  # fmt: skip
def test_ambiguous_unions_are_refused(text, said):
    with pytest.raises(ConfigError, match=said):
        read(f"wave:\n  {text}")


def test_values_become_texts_that_yaml_reads_back():
    given = {"a.b": 1e-7, "name": 'µ "x": y', "list": [1, None, True], "map": {"k": "v"}}
    texts = ["a.b=1e-07", 'name="µ \\"x\\": y"', "list=[1, null, true]", 'map={"k": "v"}']
    assert texts_of(given) == texts
    assert texts_of(("a=1", "b=2")) == ["a=1", "b=2"]
    with pytest.raises(TypeError):
        texts_of({"a": object()})

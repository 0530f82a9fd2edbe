"""Words of broken rules: names that are near, and values that may be of several types."""

from collections.abc import Mapping
from typing import Annotated, Literal

import pytest
from pydantic import Field, model_validator

from hilctl.base.errors import ConfigError
from hilctl.base.strict import StrictModel
from hilctl.base.yaml import Document, dotted, loc_of


class Guard(StrictModel):
    timeout_s: float
    kick: Literal["any", "write"] = "any"

    @model_validator(mode="after")
    def _not_both(self) -> "Guard":
        if self.timeout_s > 1.0 and self.kick == "any":
            raise ValueError("kick must be write where timeout_s is above 1")
        return self


class Several(StrictModel):
    guard: Guard | Literal["none"] = "none"
    base: Literal[0, 1, "modicon"] | None = None
    end: Literal["\r", "\n"] = "\n"
    level: float | Literal["safe"] = 0.0
    guards: Mapping[str, Guard | Literal["none"]] = Field(default_factory=dict)
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
    ("names: {A1: 1.0}",
     ["x:1: names.A1: string should match pattern '^[a-z]+$', got 'A1'"]),
])  # fmt: skip
def test_what_may_be_of_several_types(text: str, problems: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        Document("x", text).validate(Several)
    assert [str(each) for each in caught.value.problems] == problems


def test_keys_and_suggestions() -> None:
    assert dotted(("a", 0, "b")) == "a.0.b"
    assert loc_of("a.0.b") == ("a", 0, "b")
    assert loc_of("a.².b") == ("a", "²", "b")


class Wave(StrictModel):
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
])  # fmt: skip
def test_what_can_not_be_decided_is_refused(text, said):
    with pytest.raises(ConfigError, match=said):
        read(f"wave:\n  {text}")

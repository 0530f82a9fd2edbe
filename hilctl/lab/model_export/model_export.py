"""Export of a model or its inverse as one function in a C or MATLAB file."""

import re
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hilctl import __version__
from hilctl.base.errors import InputError
from hilctl.lab.model_export.kernel_translation import RESERVED, MatlabTranslator, Translator
from hilctl.models.base import HysteresisModel, Operator
from hilctl.models.linear_stages import Chain
from hilctl.models.model_file import model_sha256

_LONGEST_NAME = 48
_WIDTH = 96


def export_text(
    model: HysteresisModel, output: Path, sample_rate_hz: float, *, forward: bool = False
) -> str:
    """Return the text of a ``.c`` or ``.m`` file with a function of that name and its state.

    The function computes the inverse, or the model if ``forward``. Raise InputError if the name of
    the file or the sample rate is invalid, ModelError if the model has no inverse at this rate.
    """
    form = {".c": _CFile, ".m": _MatlabFile}.get(output.suffix)
    problems = []
    if form is None:
        problems.append("must end in .c or .m")
    if not re.fullmatch(rf"[A-Za-z]\w{{0,{_LONGEST_NAME - 1}}}", output.stem, re.ASCII):
        problems.append(
            f"must have a name of letters, digits and underscores, at most {_LONGEST_NAME}, the "
            "first one a letter, because the function gets that name"
        )
    if problems or form is None:
        raise InputError(f"{output}: {'; '.join(problems)}")
    check_rate(sample_rate_hz)
    operator = model.forward(sample_rate_hz) if forward else model.inverse(sample_rate_hz)
    names = f"command_{model.input_unit.lower()}", "displacement_um"
    source, target = names if forward else ("reference_um", names[0])
    facts = _facts(model, operator, sample_rate_hz, forward=forward)
    file = form(output.stem, source, target)
    text = file.text(operator, list(facts))
    if RESERVED.fullmatch(output.stem) or output.stem in file.translator.functions:
        raise InputError(f"{output}: the code uses the name {output.stem}: choose another name")
    return text


def check_rate(sample_rate_hz: float) -> None:
    """Raise InputError if a sample rate is not finite and > 0."""
    if not 0.0 < sample_rate_hz < np.inf:
        raise InputError(f"the sample rate must be > 0 Hz (got {sample_rate_hz!r})")


def _facts(
    model: HysteresisModel, operator: Operator, sample_rate_hz: float, *, forward: bool
) -> Iterator[str]:
    """Yield the comment lines common to both languages."""
    unit, known = model.input_unit, model.provenance.identified_range
    units = f"command in {unit} to displacement in um"
    if not forward:
        units = f"displacement in um to command in {unit}"
    yield f"{'Model' if forward else 'Inverse'} of hysteresis: {units}."
    yield ""
    yield f"model:        {model.kind}, sha256 {model_sha256(model)}"
    yield f"sample rate:  {sample_rate_hz:g} Hz; valid for no other rate"
    for name, limits, of in (
        ("displacement", model.output_range_um, "um"),
        ("command", model.input_range, unit),
    ):
        text = f"{limits[0]:g} to {limits[1]:g} {of}" if limits else "range unknown"
        yield f"{name + ':':13} {text}"
    if known is not None:
        spans = (known.peak_to_peak_um, "um peak to peak"), (known.frequency_hz, "Hz")
        texts = [f"{low:g} to {high:g} {of}" for (low, high), of in spans]
        yield f"identified:   {', '.join(texts)}, up to {known.speed_um_per_s:g} um/s"
    if operator.preview:
        lead = f"{operator.preview} samples"
        yield f"preview:      {lead}; the command belongs to the reference {lead} before"
    yield f"written by:   hilctl {__version__}"
    yield ""
    if not forward:
        yield "The command is not limited. Limit it to the range and the slew of the actuator."


def _steps(operator: Operator) -> Iterator[Operator | float]:
    """Yield the offsets and elementary operators of an operator in order of execution."""
    if operator.input_offset:
        yield operator.input_offset
    if isinstance(operator, Chain):
        for stage in operator.stages:
            yield from _steps(stage)
    else:
        yield operator
    if operator.output_offset:
        yield operator.output_offset


def _lines(texts: Iterable[str]) -> str:
    return "\n".join(texts)


def _prefixed(prefix: str, texts: Iterable[str]) -> str:
    return _lines(f"{prefix}{text}".rstrip() for text in texts)


class _CFile:
    """A C file with the function ``name``, and ``name_reset`` to initialise its memory."""

    def __init__(self, name: str, source: str, target: str) -> None:
        self.name, self.source, self.target = name, source, target
        self.translator: Translator = self._translator()
        self.constants: list[str] = []
        self.lines: list[str] = []

    _translator = Translator

    def text(self, operator: Operator, facts: list[str]) -> str:
        """Return the file."""
        at = 0
        for step in _steps(operator):
            if isinstance(step, Operator):
                size = step.state().size
                kernel = self.translator.add(step.kernel)
                *types, _, _ = kernel.arguments.values()
                values = zip(step.parameters, types[1:], strict=True)
                self._call(kernel.name, [self._argument(*each) for each in values], at, size)
                at += size
            else:
                self._add(self.translator.literal(step))
        return self._assembled(operator, facts)

    def _argument(self, value: Any, kind: Any) -> str:
        if isinstance(value, np.ndarray):
            self.constants.append(self._constant(f"c{len(self.constants) + 1}", value))
            return self._array(f"c{len(self.constants)}", value.shape)
        if isinstance(value, tuple):
            items = [self._argument(*each) for each in zip(value, kind, strict=True)]
            return self.translator.tuple_of(items, kind)
        return self.translator.literal(kind(value))

    def _numbers(self, values: np.ndarray[Any, Any]) -> str:
        """Return numbers separated by commas, in lines."""
        texts = [self.translator.literal(float(value)) for value in values.ravel(order=self._order)]
        return "\n".join(textwrap.wrap(", ".join(texts), _WIDTH))

    _order: Any = "C"

    def _constant(self, name: str, values: np.ndarray[Any, Any]) -> str:
        numbers = self._numbers(values) or "0.0"
        return f"static const double {name}[] = {{\n{numbers}\n}};"

    def _array(self, name: str, shape: tuple[int, ...]) -> str:
        sizes = ", ".join(map(str, (*shape, 1, 1)[:3]))
        return f"(array){{(double *){name}, {sizes}}}"

    def _add(self, offset: str) -> None:
        self.lines.append(
            f"for (k = 0; k < n; k++) {self.target}[k] = {self.target}[k] + {offset};"
        )

    def _call(self, kernel: str, arguments: list[str], at: int, size: int) -> None:
        memory = f"(array){{memory + {at}, {size}, 1, 1}}"
        inner = ",\n        ".join(["signal", *arguments, memory, "signal"])
        self.lines.append(f"{kernel}({inner});")

    def _assembled(self, operator: Operator, facts: list[str]) -> str:
        name, size = self.name, operator.state().size
        signals = f"const double *{self.source}, double *{self.target}"
        head = [
            *facts,
            "Compile with -ffp-contract=off for the same results as in hilctl.",
            "",
            f"    double memory[{name}_memory];",
            f"    {name}_reset(memory);    at rest",
            f"    {name}(memory, {self.source}, {self.target}, n);    n samples, for each block",
        ]
        structures = "".join(
            f"typedef struct {{ {members} }} {kind};\n"
            for kind, members in self.translator.structures.items()
        )
        return f"""\
/*
{_prefixed(" * ", head)}
 */

#include <math.h>

enum {{ {name}_memory = {size}, {name}_preview = {operator.preview} }};

typedef struct {{ double *at; int n0, n1, n2; }} array;
{structures}
{_lines(self.constants)}

{self._functions()}

void {name}_reset(double *memory)
{{
    static const double rest[] = {{
{self._numbers(operator.state())}
}};
    int k;
    for (k = 0; k < {size}; k++) memory[k] = rest[k];
}}

void {name}(double *memory, {signals}, int n)
{{
    const array signal = {{{self.target}, n, 1, 1}};
    int k;
    for (k = 0; k < n; k++) {self.target}[k] = {self.source}[k];
{_prefixed("    ", self.lines)}
}}
"""

    def _functions(self) -> str:
        return "\n\n".join(self.translator.functions.values())


class _MatlabFile(_CFile):
    """A MATLAB file with the function ``name``."""

    _translator = MatlabTranslator
    _order = "F"

    def _constant(self, name: str, values: np.ndarray[Any, Any]) -> str:
        sizes = values.shape if values.ndim > 1 else (1, values.size)
        return f"    {name} = reshape({self._list(values)}, {list(sizes)});"

    def _list(self, values: np.ndarray[Any, Any]) -> str:
        return f"[{self._numbers(values)}]".replace("\n", " ...\n")

    def _array(self, name: str, shape: tuple[int, ...]) -> str:
        return name

    def _add(self, offset: str) -> None:
        self.lines.append(f"{self.target} = {self.target} + {offset};")

    def _call(self, kernel: str, arguments: list[str], at: int, size: int) -> None:
        part = f"memory({at + 1}:{at + size})"
        inner = ", ".join([self.target, *arguments, part, self.target])
        self.lines.append(f"[{part}, {self.target}] = {kernel}({inner});")

    def _assembled(self, operator: Operator, facts: list[str]) -> str:
        call = f"[{self.target}, memory] = {self.name}({self.source}"
        head = [
            f"{self.name.upper()} {facts[0]}",
            *facts[1:],
            "",
            f"    {call});            from rest",
            f"    {call}, memory);    continued",
        ]
        return f"""\
function {call}, memory)
{_prefixed("% ", head)}
    if nargin < 2
        memory = {self._list(operator.state())};
    end
{_lines(self.constants)}
    {self.target} = {self.source};
{_prefixed("    ", self.lines)}
end

{self._functions()}
"""

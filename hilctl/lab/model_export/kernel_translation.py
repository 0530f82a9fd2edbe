"""Translator of kernels and their callees from Python to C or MATLAB.

A kernel is restricted Python: numbers, arrays of numbers and tuples of them, with annotated
arguments. Each of its statements has one counterpart in C and in MATLAB, so the results agree to
the last bits of ``exp`` and similar functions. Other syntax raises an error.

In C a tuple is a structure. In MATLAB it is a cell array, and a function returns each array that
it changes. A MATLAB expression can neither change an array nor choose between two values: such
operations become statements before it.
"""

import ast
import inspect
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any, ClassVar, TypeAlias, get_args, get_type_hints

from hilctl.base.errors import ModelError
from hilctl.base.types import F64

Type: TypeAlias = Any
"""Type of a value: ``float``, ``int``, ``F64``, a tuple of types, or None."""
Value: TypeAlias = tuple[str, Type]
"""Translated expression and its type."""

_MATH = re.compile("atan|atanh|copysign|exp|expm1|floor|isnan|log|log1p|sqrt|tan|tanh")
RESERVED = re.compile(
    rf"{_MATH.pattern}|abs|array|auto|break|case|catch|char|const|continue|default|do|double|else|"
    "elseif|end|enum|extern|fabs|false|fix|float|for|function|global|goto|if|inline|int|long|main|"
    "max_|min_|mod|numel|otherwise|persistent|register|return|short|signed|size|sizeof|static|"
    "struct|switch|true|try|typedef|union|unsigned|void|volatile|while"
)
"""Names that neither a variable of a translated kernel nor an exported function can have."""
_SIGNS: dict[type[ast.AST], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.And: "&&", ast.Or: "||",
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip


@dataclass(frozen=True)
class KernelSource:
    """A kernel to translate.

    Attributes:
        name: Name of the translated function.
        arguments: Types of its arguments, by name.
        returns: Type of its result.
        changed: Names of the arrays that the kernel changes.
        callees: Kernels that the kernel calls, by their name in Python.
    """

    name: str
    function: Callable[..., Any]
    node: ast.FunctionDef
    arguments: dict[str, Type]
    returns: Type
    changed: tuple[str, ...]
    callees: dict[str, "KernelSource"]


@cache
def source_of(kernel: Callable[..., Any]) -> KernelSource:
    """Return the source of a kernel."""
    function = getattr(kernel, "py_func", kernel)
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    assert isinstance(node, ast.FunctionDef)
    node.decorator_list = []
    names, nodes = function.__globals__, list(ast.walk(node))
    hints = {name: _type_of(hint) for name, hint in get_type_hints(function).items()}
    calls = [each for each in nodes if isinstance(each, ast.Call)]
    called = {each.func.id for each in calls if isinstance(each.func, ast.Name)}
    callees = {name: source_of(names[name]) for name in sorted(called & names.keys())}
    changed = _stored(node.body)
    changed.update(each.id for call in calls for each in _changed_by(call, callees))
    private = function.__name__.startswith("_")
    return KernelSource(
        name=(function.__module__.rpartition(".")[2] if private else "") + function.__name__,
        function=function,
        node=node,
        returns=hints.pop("return"),
        arguments=hints,
        changed=tuple(name for name, kind in hints.items() if kind == F64 and name in changed),
        callees=callees,
    )


def _stored(statements: Iterable[ast.stmt]) -> set[str]:
    """Return the names of the variables and arrays that statements store to."""
    nodes = (each for statement in statements for each in ast.walk(statement))
    stored = (each for each in nodes if isinstance(each, ast.Subscript | ast.Name))
    return {_root(each) for each in stored if isinstance(each.ctx, ast.Store)} - {"_"}


def _root(target: ast.expr) -> str:
    return ast.unparse(target).partition("[")[0]


def _names(node: ast.AST) -> list[str]:
    return [each.id for each in ast.walk(node) if isinstance(each, ast.Name)]


def _type_of(hint: Any) -> Type:
    if hint is type(None):
        return None
    return hint if hint in (float, int, F64) else tuple(map(_type_of, get_args(hint)))


def _changed_by(call: ast.Call, callees: dict[str, KernelSource]) -> list[ast.Name]:
    """Return the arguments that a call changes."""
    callee = callees.get(ast.unparse(call.func))
    pairs = zip(call.args, callee.arguments, strict=True) if callee else ()
    changed = callee.changed if callee else ()
    return [arg for arg, name in pairs if name in changed and isinstance(arg, ast.Name)]


class Translator:
    """Translates kernels to C.

    Attributes:
        functions: Translated functions by name, callees before callers.
        structures: Members of the structures by name.
    """

    comment: ClassVar = ("/* ", " */")
    block: ClassVar = (" {", "} else {", "}")
    """End of the first line of a block, line between the two branches, last line."""
    negation: ClassVar = "!"
    first: ClassVar = 0
    """Index of the first item."""
    helpers: ClassVar = {
        "min_": "static double min_(double a, double b) { return b < a ? b : a; }",
        "max_": "static double max_(double a, double b) { return b > a ? b : a; }",
    }
    """Functions that differ from built-in ones for NaN or -0."""
    forms: ClassVar = {
        "int": "(int)({})", "abs": "fabs({})", "FloorDiv": "{} / {}", "Mod": "{} % {}",
        "size": "{}.n0", "shape": "{}.n{}", "item": "{}.f{}", "tuple": "({0}){{{1}}}",
        "range": "for ({0} = {1}; {0} < {2}; {0}++)", "while": "while ({})", "if": "if ({})",
        "new": "const {} {} = {};", "return": "return {};",
    }  # fmt: skip

    def __init__(self) -> None:
        self.functions: dict[str, str] = {}
        self.structures: dict[str, str] = {}
        self._kernel: KernelSource
        self._lines: list[str]
        self._types: dict[str, Type]
        self._temporaries = 0
        self._depth = 1

    def add(self, kernel: Callable[..., Any]) -> KernelSource:
        """Translate a kernel and its callees; return its source, or raise ModelError."""
        source = source_of(kernel)
        if source.name in self.functions:
            return source
        for callee in source.callees.values():
            self.add(callee.function)
        self._kernel, self._types = source, dict(source.arguments)
        for _ in range(2):  # the first pass determines the types of all variables
            self._lines, self._temporaries = [], 0
            self._statements(source.node.body)
        summary = re.sub(":func:|`", "", inspect.getdoc(source.function) or "").partition("\n")[0]
        head = [summary.join(self.comment)] if summary else []
        self.functions[source.name] = "\n".join([*head, *self._function()])
        return source

    def _form(self, name: str, *parts: object) -> str:
        return self.forms[name].format(*parts)

    def _error(self, node: ast.AST) -> ModelError:
        code = self._kernel.function.__code__
        line = code.co_firstlineno - 1 + getattr(node, "lineno", 1)
        return ModelError(f"{code.co_filename}:{line}: cannot be translated: {ast.unparse(node)}")

    def _write(self, line: str) -> None:
        self._lines.append("    " * self._depth + line)

    # Statements

    def _statements(self, nodes: Sequence[ast.stmt], deeper: int = 0) -> None:
        self._depth += deeper
        for node in nodes:
            if isinstance(node, ast.If | ast.While | ast.For):
                self._compound(node)
            else:
                self._check_order(node)
                self._simple(node)
        self._depth -= deeper

    def _check_order(self, node: ast.stmt) -> None:
        """Reject a statement that both uses an array and calls a kernel that changes it."""
        for call in (each for each in ast.walk(node) if isinstance(each, ast.Call)):
            for array in _changed_by(call, self._kernel.callees):
                if _names(node).count(array.id) > _names(call).count(array.id):
                    raise self._error(node)

    def _simple(self, node: ast.stmt) -> None:
        match node:
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=value):
                self._unpack(targets, value)
            case ast.Assign(targets=targets, value=value):
                text, kind = self._value(value)
                for target in targets:
                    self._store(target, text, kind)
            case ast.AugAssign(target=target, op=op, value=value):
                self._store(target, *self._value(ast.BinOp(target, op, value)))
            case ast.Return(value=ast.expr() as value):
                text, _ = self._value(value, self._kernel.returns)
                self._write(self._form("return", text))
            case ast.Expr(value=ast.Constant(value=str())):
                pass  # the docstring
            case ast.Expr(value=ast.Call() as call):
                if text := self._value(call)[0]:
                    self._write(f"{text};")
            case ast.Break():
                self._write("break;")
            case _:
                raise self._error(node)

    def _compound(self, node: ast.If | ast.While | ast.For) -> None:
        start, between, end = self.block
        match node:
            case ast.For(
                target=ast.Name(id=name),
                iter=ast.Call(func=ast.Name(id="range"), args=[] | [_] | [_, _] as args),
                orelse=[],
            ):
                low, high = ("0", *(self._value(arg)[0] for arg in args))[-2:]
                if _stored(node.body) & {name, *_names(node.iter)}:  # C evaluates it in every pass
                    raise self._error(node.iter)
                self._types[name] = int
                if not re.fullmatch(r"[\w.()]+", high):
                    high = self._temporary(high, int)
                self._write(self._form("range", self._named(name), low, high) + start)
            case ast.While(test=test, orelse=[]):
                before = len(self._lines)
                self._write(self._form("while", self._value(test)[0]) + start)
                if len(self._lines) > before + 1:  # it would need statements in every pass
                    raise self._error(test)
            case ast.If(test=test):
                self._write(self._form("if", self._value(test)[0]) + start)
            case _:
                raise self._error(node)
        self._statements(node.body, 1)
        if node.orelse:
            self._write(between)
            self._statements(node.orelse, 1)
        self._write(end)

    def _unpack(self, targets: Sequence[ast.expr], value: ast.expr) -> None:
        values = self._items(value)
        roots = [*map(_root, targets)]
        later = value.elts[1:] if isinstance(value, ast.Tuple) else []
        if any({*_names(each)} & {*roots[: i + 1]} for i, each in enumerate(later)):
            values = [(self._temporary(text, kind), kind) for text, kind in values]
        for target, (text, kind) in zip(targets, values, strict=True):
            if ast.unparse(target) != "_":
                self._store(target, text, kind)

    def _items(self, node: ast.expr) -> list[Value]:
        """Translate the items of a tuple."""
        match node:
            case ast.Tuple(elts=elements):
                return [self._value(each) for each in elements]
            case ast.Subscript(
                value=whole,
                slice=ast.Slice(lower=ast.Constant() as low, upper=ast.Constant() as high),
            ):
                return self._items(whole)[ast.literal_eval(low) : ast.literal_eval(high)]
        text, kind = self._value(node)
        if isinstance(node, ast.Call):
            text = self._temporary(text, kind)
        return [(self._form("item", text, i + self.first), each) for i, each in enumerate(kind)]

    def _store(self, target: ast.expr, text: str, kind: Type) -> None:
        match target:
            case ast.Name(id=name):
                self._types[name] = self._joined(target, self._types.get(name, kind), kind)
                self._write(f"{self._named(name)} = {text};")
            case ast.Subscript(value=ast.Name(id=name)) if name in self._kernel.changed:
                self._write(f"{self._value(target)[0]} = {text};")
            case _:
                raise self._error(target)

    # Expressions

    def _value(self, node: ast.expr, wanted: Type = None) -> Value:
        """Translate an expression; ``wanted`` is the type of a tuple."""
        match node:
            case ast.Constant(value=value):
                return self._number(value)
            case ast.Name(id=name):
                return self._name(node, name)
            case ast.Attribute(value=value, attr=attribute):
                return self._attribute(node, value, attribute)
            case ast.Subscript(value=value, slice=index):
                return self._subscript(node, value, index)
            case ast.Tuple(elts=elements):
                texts, types = zip(*(self._value(each) for each in elements), strict=True)
                kind = wanted or types
                return self.tuple_of(texts, kind), kind
            case ast.IfExp(test=test, body=body, orelse=other):
                return self._choice(self._value(test)[0], body, other)
            case ast.Call():
                return self._call(node)
        return self._operation(node)

    def _operation(self, node: ast.expr) -> Value:
        match node:
            case ast.BinOp(left=left, op=op, right=right):
                (a, one), (b, other) = self._operand(left), self._operand(right)
                kind = self._joined(node, one, other)
                if isinstance(op, ast.FloorDiv | ast.Mod) and kind is int:
                    return self._form(type(op).__name__, a, b), int
                if type(op) in _SIGNS and not (isinstance(op, ast.Div) and kind is int):
                    return f"{a} {_SIGNS[type(op)]} {b}", kind
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                text, kind = self._operand(operand)
                return f"-{text}", kind
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return f"{self.negation}{self._operand(operand)[0]}", int
            case ast.BoolOp(op=op, values=values):
                parts = [self._operand(each)[0] for each in values]
                return f" {_SIGNS[type(op)]} ".join(parts), int
            case ast.Compare(left=left, ops=ops, comparators=others) if _SIGNS.keys() >= {
                type(op) for op in ops
            }:
                texts = [self._operand(each)[0] for each in (left, *others)]
                signs = [_SIGNS[type(op)].replace("!", self.negation) for op in ops]
                parts = [f"{texts[i]} {sign} {texts[i + 1]}" for i, sign in enumerate(signs)]
                return " && ".join(parts), int
        raise self._error(node)

    def _operand(self, node: ast.expr) -> Value:
        """Translate an operand, in brackets if it has an operator."""
        text, kind = self._value(node)
        compound = isinstance(node, ast.BinOp | ast.BoolOp | ast.Compare | ast.UnaryOp)
        return (f"({text})" if compound else text), kind

    def _joined(self, node: ast.AST, *types: Type) -> Type:
        """Return the common type of several possible values."""
        if len(set(types)) == 1:
            return types[0]
        if not set(types) <= {float, int}:
            raise self._error(node)
        return float

    def _name(self, node: ast.expr, name: str) -> Value:
        if name in self._types:
            return self._named(name), self._types[name]
        value = self._kernel.function.__globals__.get(name)
        if not isinstance(value, int | float):
            raise self._error(node)
        return self._number(value)

    def _attribute(self, node: ast.expr, value: ast.expr, attribute: str) -> Value:
        module = self._kernel.function.__globals__.get(ast.unparse(value))
        number = getattr(module, attribute, None)  # math.inf
        if isinstance(module, ModuleType) and isinstance(number, float):
            return self._number(number)
        text, kind = self._value(value)
        if kind != F64 or attribute != "size":
            raise self._error(node)
        return self._form("size", text), int

    def _subscript(self, node: ast.expr, value: ast.expr, index: ast.expr) -> Value:
        match value, index:
            case ast.Attribute(value=array, attr="shape"), ast.Constant() as axis:
                number = ast.literal_eval(axis) + self.first
                return self._form("shape", self._value(array)[0], number), int
        text, kind = self._value(value)
        if isinstance(kind, tuple) and isinstance(index, ast.Constant):
            item = ast.literal_eval(index)
            return self._form("item", text, item + self.first), kind[item]
        indices = index.elts if isinstance(index, ast.Tuple) else [index]
        places = [self._value(each) for each in indices]
        if kind != F64 or any(each is not int for _, each in places):
            raise self._error(node)
        return self._element(text, [place for place, _ in places]), float

    def _call(self, node: ast.Call) -> Value:
        match node:
            case ast.Call(func=ast.Name(id=name)) if name in self._kernel.callees:
                callee = self._kernel.callees[name]
                typed = zip(node.args, callee.arguments.values(), strict=True)
                args = [self._value(arg, kind)[0] for arg, kind in typed]
                return self._kernel_call(node, callee, args), callee.returns
            case ast.Call(func=ast.Attribute(value=ast.Name(id="math"), attr=name), args=args):
                if _MATH.fullmatch(name):
                    return self._math(name, *(self._value(arg)[0] for arg in args)), float
            case ast.Call(func=ast.Name(id="abs"), args=[arg]):
                return self._form("abs", self._value(arg)[0]), float
            case ast.Call(func=ast.Name(id="int"), args=[arg]):
                text, kind = self._value(arg)
                return (text if kind is int else self._form("int", text)), int
            case ast.Call(func=ast.Name(id="float"), args=[arg]):
                text, kind = self._value(arg)
                return (text if kind is float else f"1.0 * ({text})"), float
            case ast.Call(func=ast.Name(id="min" | "max" as name), args=[first, second]):
                (a, one), (b, other) = self._value(first), self._value(second)
                text, kind = self._math(f"{name}_", a, b), self._joined(node, one, other)
                return (text if kind is float else self._form("int", text)), kind
        raise self._error(node)

    def _named(self, name: str) -> str:
        name = "count" if name == "_" else name
        return f"{name}_" if RESERVED.fullmatch(name) else name

    def _new_name(self) -> str:
        self._temporaries += 1
        return f"t{self._temporaries}_"

    def _number(self, value: Any) -> Value:
        return self.literal(value), float if isinstance(value, float) else int

    # Differences between the languages

    def literal(self, value: float) -> str:
        """Return a number."""
        if isinstance(value, int):
            return str(int(value))
        return "NAN" if math.isnan(value) else repr(float(value)).replace("inf", "INFINITY")

    def type_name(self, kind: Type) -> str:
        """Return the name of a type, and define it if it is a tuple."""
        if not isinstance(kind, tuple):
            return {float: "double", int: "int", F64: "array", None: "void"}[kind]
        types = [self.type_name(each) for each in kind]
        name = "tuple_" + "".join(each.removeprefix("tuple_")[0] for each in types)
        members = " ".join(f"{each} f{i};" for i, each in enumerate(types))
        while self.structures.setdefault(name, members) != members:
            name += "_"
        return name

    def _function(self) -> list[str]:
        """Return the lines of the current function."""
        source = self._kernel
        local: dict[str, list[str]] = {}
        for name in self._types.keys() - source.arguments.keys():
            local.setdefault(self.type_name(self._types[name]), []).append(self._named(name))
        typed = [
            f"{self.type_name(kind)} {self._named(name)}" for name, kind in source.arguments.items()
        ]
        head = f"static {self.type_name(source.returns)} {source.name}({', '.join(typed)})"
        lines = [f"    {kind} {', '.join(sorted(local[kind]))};" for kind in sorted(local)]
        return [head, "{", *lines, *self._lines, "}"]

    def _temporary(self, text: str, kind: Type) -> str:
        """Store a value in a new variable, and return its name."""
        name = self._new_name()
        self._write(self._form("new", self.type_name(kind), name, text))
        return name

    def tuple_of(self, items: Sequence[str], kind: Type) -> str:
        """Return a tuple."""
        return self._form("tuple", self.type_name(kind), ", ".join(items))

    def _element(self, array: str, places: Sequence[str]) -> str:
        place = places[0]
        for axis, each in enumerate(places[1:], start=1):
            place = f"({place}) * {array}.n{axis} + {each}"
        return f"{array}.at[{place}]"

    def _math(self, name: str, *args: str) -> str:
        if name in self.helpers:
            self.functions.setdefault(name, self.helpers[name])
        return f"{name}({', '.join(args)})"

    def _choice(self, test: str, body: ast.expr, other: ast.expr) -> Value:
        (a, one), (b, another) = self._value(body), self._value(other)
        return f"({test} ? {a} : {b})", self._joined(body, one, another)

    def _kernel_call(self, node: ast.Call, callee: KernelSource, args: Sequence[str]) -> str:
        return f"{callee.name}({', '.join(args)})"


class MatlabTranslator(Translator):
    """Translates kernels to MATLAB, in the subset that Octave supports."""

    comment: ClassVar = ("% ", "")
    block: ClassVar = ("", "else", "end")
    negation: ClassVar = "~"
    helpers: ClassVar = {
        name: f"function a = {name}(a, b)\n    if {test}\n        a = {value};\n    end\nend"
        for name, test, value in (
            ("min_", "b < a", "b"),
            ("max_", "b > a", "b"),
            ("copysign", "(a < 0 || 1 / a < 0) ~= (b < 0 || 1 / b < 0)", "-a"),
        )
    }
    first: ClassVar = 1
    forms: ClassVar = {
        "int": "fix({})", "abs": "abs({})", "FloorDiv": "floor({} / {})", "Mod": "mod({}, {})",
        "size": "numel({})", "shape": "size({}, {})", "item": "{}{{{}}}", "tuple": "{{{1}}}",
        "range": "for {} = {}:{} - 1", "while": "while {}", "if": "if {}",
        "new": "{1} = {2};", "return": "result_ = {}; return;",
    }  # fmt: skip

    def literal(self, value: float) -> str:
        """Return a number."""
        return f"{value!r}".lower().replace("nan", "NaN").replace("inf", "Inf")

    def _function(self) -> list[str]:
        source = self._kernel
        results = ["result_"] * (source.returns is not None) + self._all_named(source.changed)
        args = ", ".join(self._all_named(source.arguments))
        return [f"function [{', '.join(results)}] = {source.name}({args})", *self._lines, "end"]

    def _all_named(self, names: Iterable[str]) -> list[str]:
        return [self._named(name) for name in names]

    def _element(self, array: str, places: Sequence[str]) -> str:
        counted = [str(int(each) + 1) if each.isdecimal() else f"{each} + 1" for each in places]
        return f"{array}({', '.join(counted)})"

    def _choice(self, test: str, body: ast.expr, other: ast.expr) -> Value:
        name, types = self._new_name(), []
        for line, node in ((self._form("if", test), body), ("else", other)):
            self._write(line)
            self._depth += 1
            text, kind = self._value(node)
            self._write(f"{name} = {text};")
            self._depth -= 1
            types.append(kind)
        self._write("end")
        return name, self._joined(body, *types)

    def _kernel_call(self, node: ast.Call, callee: KernelSource, args: Sequence[str]) -> str:
        text = super()._kernel_call(node, callee, args)
        changed = self._all_named(each.id for each in _changed_by(node, self._kernel.callees))
        if not changed and not isinstance(callee.returns, tuple):
            return text
        name = "" if callee.returns is None else self._new_name()
        results = [name, *changed] if name else changed
        self._write(f"[{', '.join(results)}] = {text};")
        return name

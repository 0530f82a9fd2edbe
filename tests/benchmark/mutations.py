"""Every small change of a module's source, by a plain set of operators.

| name | change |
|---|---|
| compare | ``<`` to ``<=`` and ``>=``, and so on; ``==`` to ``!=``, ``is`` to ``is not``, ``in`` to ``not in`` |
| arithmetic | ``+`` and ``-``, ``*`` and ``/``, ``&`` and ``|``, ``<<`` and ``>>``; ``//``, ``%`` and ``**`` to ``*`` |
| boolean | ``and`` and ``or``; ``not`` and the sign left out; True and False |
| condition | a condition without any of these turned round |
| constant | a number one more; 1 to 0 |
| return | None returned |
| delete | a call, an assignment, ``assert``, ``del`` or ``raise`` left out, inside functions |
| jump | ``break`` and ``continue`` |
| handler | an exception not handled |

Strings, annotations and decorators stay.
"""  # noqa: E501  a table

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass

_COMPARE: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip
_PLAIN = ast.Compare | ast.BoolOp | ast.UnaryOp | ast.Constant
_STAYS = {"annotation", "returns", "decorator_list"}


@dataclass(frozen=True)
class Mutation:
    """One change of a source.

    Attributes:
        line: Where.
        operator: Which of the above.
        before: The lines that it changes, as one.
        after: What they become.
        source: All of it, changed.
    """

    line: int
    operator: str
    before: str
    after: str
    source: str

    @property
    def change(self) -> tuple[str, str]:
        """Before and after."""
        return self.before, self.after


def mutations(source: str) -> list[Mutation]:
    """Return every mutation of a module's source that gives another one, in order of lines."""
    data, starts = source.encode(), [0]
    for line in data.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found: dict[bytes, Mutation] = {}
    for operator, first, last, text in _walk(ast.parse(source), None, inside=False):
        begin, end = starts[first.lineno - 1], starts[last.end_lineno]
        start, stop = begin + first.col_offset, starts[last.end_lineno - 1] + last.end_col_offset
        after = data[begin:start] + text.encode() + data[stop:end]
        mutant = data[:begin] + after + data[end:]
        sides = (" ".join(lines.decode().split()) for lines in (data[begin:end], after))
        found.setdefault(mutant, Mutation(first.lineno, operator, *sides, mutant.decode()))
    return sorted(found.values(), key=lambda mutation: mutation.line)


def _walk(
    node: ast.AST, text: ast.JoinedStr | None, *, inside: bool
) -> Iterator[tuple[str, ast.expr, ast.expr, str]]:
    """Yield changes: the operator, the first and last node that go, and what comes there.

    Args:
        node: Where to begin.
        text: The f-string around it; Python 3.11 does not know where on a line its parts stand.
        inside: Whether it stands in a function.
    """
    if isinstance(node, ast.JoinedStr):
        text = text or node
    if isinstance(node, ast.expr):
        place = text or node
        for operator, new in _expressions(node):
            yield operator, place, place, f"({ast.unparse(copy.deepcopy(place, {id(node): new}))})"
    elif inside or isinstance(node, ast.ExceptHandler):
        yield from _statements(node)
    if isinstance(node, ast.If | ast.While | ast.IfExp) and not isinstance(node.test, _PLAIN):
        yield "condition", node.test, node.test, f"(not ({ast.unparse(node.test)}))"
    inside = inside or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    inside = inside and not isinstance(node, ast.ClassDef)
    for field, value in ast.iter_fields(node):
        if field not in _STAYS:
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from _walk(child, text, inside=inside)


def _expressions(node: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    """Yield the operator and the changed node."""
    match node:
        case ast.Compare(left, ops, comparators):
            for i, op in enumerate(ops):
                for other in _COMPARE[type(op)]:
                    yield (
                        "compare",
                        ast.Compare(left, [*ops[:i], other(), *ops[i + 1 :]], comparators),
                    )
        case ast.BinOp(left, op, right) if type(op) in _ARITHMETIC:
            yield "arithmetic", ast.BinOp(left, _ARITHMETIC[type(op)](), right)
        case ast.BoolOp(op, values):
            yield "boolean", ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
        case ast.UnaryOp(ast.Not() | ast.USub(), operand):
            yield "boolean", operand
        case ast.Constant(bool(value)):
            yield "boolean", ast.Constant(not value)
        case ast.Constant(int(value) | float(value)):
            yield "constant", ast.Constant(value + 1)
            if value == 1:
                yield "constant", ast.Constant(value - 1)


def _statements(node: ast.AST) -> Iterator[tuple[str, ast.AST, ast.AST, str]]:
    match node:
        case ast.Return(ast.expr() as value) if not _is_none(value):
            yield "return", value, value, "None"
        case ast.AugAssign(_, op, _) if type(op) in _ARITHMETIC:
            other = ast.AugAssign(node.target, _ARITHMETIC[type(op)](), node.value)
            yield "arithmetic", node, node, ast.unparse(other)
            yield "delete", node, node, "pass"
        case ast.Expr(ast.Call()) | ast.Assign() | ast.AnnAssign(value=ast.expr()):
            yield "delete", node, node, "pass"
        case ast.Raise() | ast.Assert() | ast.Delete() | ast.AugAssign():
            yield "delete", node, node, "pass"
        case ast.Break():
            yield "jump", node, node, "continue"
        case ast.Continue():
            yield "jump", node, node, "break"
        case ast.ExceptHandler():
            yield "handler", node.body[0], node.body[-1], "raise"


def _is_none(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is None

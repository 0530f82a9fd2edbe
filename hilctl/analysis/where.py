"""Conditions on runs, as in ``frequency_hz > 100 and label.sample == "A7"``.

They look like Python and are read by its parser, but nothing is run: what may stand in one is in
:class:`RunCondition`. What is not known of a run matches nothing, nor does its contrary, as in SQL.
"""

import ast
import difflib
import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

from hilctl.base.errors import InputError
from hilctl.base.printable import printable

RunValues: TypeAlias = Mapping[str, Any]
"""The value of each name for one run; None where it is not known."""
_Truth: TypeAlias = Callable[[RunValues], bool | None]
_Term: TypeAlias = Callable[[RunValues], Any]

_log = logging.getLogger(__name__)

_LONGEST = 2000
_HINT = "compare names with ==, !=, <, <=, >, >=, in, not in; join with and, or, not"
_ORDERS: Mapping[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: lambda a, b: a < b,
    ast.LtE: lambda a, b: a <= b,
    ast.Gt: lambda a, b: a > b,
    ast.GtE: lambda a, b: a >= b,
}


class RunCondition:
    """A condition on the values of a run.

    It may hold names with points, names of labels that are none in Python as ``label["class"]``,
    numbers, texts, ``True``, ``False``, ``None`` for what is not known, lists of these, comparisons
    (chains too), ``in`` and ``not in`` a list or a text, ``and``, ``or``, ``not`` and brackets.

    Args:
        text: What was typed.

    Attributes:
        names: The names in it.

    Raises:
        InputError: It can't be read, or holds something else.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self.names: dict[str, None] = {}
        if len(text) > _LONGEST:
            raise InputError(f"--where: has {len(text)} characters, more than {_LONGEST}")
        try:
            tree = ast.parse(text.strip(), mode="eval")
            self._truth = self._as_truth(tree.body)
        except SyntaxError as error:
            place = f" at character {error.offset}" if error.offset else ""
            raise self._refused(f"can't be read{place}: {error.msg}") from None
        except (ValueError, RecursionError, MemoryError):
            raise self._refused("can't be read") from None

    def matches(self, values: RunValues) -> bool:
        """Return whether it is true of a run; False where that is not known."""
        return self._truth(values) is True

    def _refused(self, what: str) -> InputError:
        return InputError(f"--where {printable(self._text)}: {what} ({_HINT})")

    def _as_truth(self, node: ast.expr) -> _Truth:
        match node:
            case ast.BoolOp(op=op, values=nodes):
                parts = [self._as_truth(each) for each in nodes]
                # As in SQL: one False decides an and, one True an or, and else the unknown does.
                decides = isinstance(op, ast.Or)
                return lambda values: _joined((part(values) for part in parts), decides)
            case ast.UnaryOp(op=ast.Not(), operand=inner):
                truth = self._as_truth(inner)
                return lambda values: None if (known := truth(values)) is None else not known
            case ast.Compare(left=left, ops=ops, comparators=nodes):
                terms = [self._as_term(each) for each in (left, *nodes)]
                return self._comparisons(terms, ops, [left, *nodes])
            case ast.Name() | ast.Attribute() | ast.Subscript() | ast.Constant(value=bool()):
                term = self._as_term(node)
                return lambda values: known if isinstance(known := term(values), bool) else None
        raise self._refused(f"{self._source(node)} is no condition")

    def _comparisons(
        self, terms: Sequence[_Term], ops: Sequence[ast.cmpop], nodes: Sequence[ast.expr]
    ) -> _Truth:
        pairs: list[_Truth] = []
        for k, op in enumerate(ops):
            # Against None itself a comparison asks whether something is known.
            known = any(isinstance(n, ast.Constant) and n.value is None for n in nodes[k : k + 2])
            pairs.append(self._comparison(op, terms[k], terms[k + 1], of_none=known))
        return lambda values: _joined((pair(values) for pair in pairs), decides=False)

    def _comparison(self, op: ast.cmpop, left: _Term, right: _Term, *, of_none: bool) -> _Truth:
        if type(op) in _ORDERS:
            order = _ORDERS[type(op)]
            return lambda values: _ordered(order, left(values), right(values))
        contrary = isinstance(op, ast.NotEq | ast.NotIn | ast.IsNot)
        if isinstance(op, ast.In | ast.NotIn):
            test = _within
        elif isinstance(op, ast.Eq | ast.NotEq) or of_none:
            test = _same_or_both_unknown if of_none else _same
        else:
            raise self._refused("'is' stands before None only")

        def compared(values: RunValues) -> bool | None:
            found = test(left(values), right(values))
            return found if found is None else found != contrary

        return compared

    def _as_term(self, node: ast.expr) -> _Term:
        match node:
            case ast.Constant(value=str() | int() | float() | None as value):
                return lambda values: value
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as number)):
                return lambda values: -number
            case ast.List(elts=nodes) | ast.Tuple(elts=nodes) | ast.Set(elts=nodes):
                terms = [self._as_term(each) for each in nodes]
                return lambda values: [term(values) for term in terms]
            case ast.Name() | ast.Attribute() | ast.Subscript():
                name = self._as_name(node)
                self.names[name] = None
                return lambda values: values[name]
        raise self._refused(f"{self._source(node)} can't stand here")

    def _as_name(self, node: ast.expr) -> str:
        match node:
            case ast.Name(id=name):
                return name
            case ast.Attribute(value=inner, attr=name):
                return f"{self._as_name(inner)}.{name}"
            case ast.Subscript(value=inner, slice=ast.Constant(value=str() as name)):
                return f"{self._as_name(inner)}.{name}"
        raise self._refused(f"{self._source(node)} is no name")

    @staticmethod
    def _source(node: ast.expr) -> str:
        return printable(ast.unparse(node))


def _joined(parts: Iterable[bool | None], decides: bool) -> bool | None:
    unknown = False
    for part in parts:
        if part is decides:
            return decides
        unknown = unknown or part is None
    return None if unknown else not decides


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _ordered(order: Callable[[Any, Any], bool], left: Any, right: Any) -> bool | None:
    texts = isinstance(left, str) and isinstance(right, str)
    return order(left, right) if texts or (_is_number(left) and _is_number(right)) else None


def _same(left: Any, right: Any) -> bool | None:
    if left is None or right is None:
        return None
    return bool(left == right) and isinstance(left, bool) == isinstance(right, bool)


def _same_or_both_unknown(left: Any, right: Any) -> bool:
    return left is None and right is None


def _within(left: Any, right: Any) -> bool | None:
    if left is None or right is None:
        return None
    if isinstance(right, str):
        return left in right if isinstance(left, str) else None
    return any(_same(left, each) for each in right) if isinstance(right, list) else None


def check_names(names: Collection[str], known: Collection[str], prefixes: Sequence[str]) -> None:
    """Refuse names that no run can have, and say of those that none has.

    Args:
        names: What was asked for.
        known: All names that a run has.
        prefixes: What names begin with that any run may have of its own, each with its point.

    Raises:
        InputError: One is of neither; the nearest are given.
    """
    for name in sorted(set(names) - set(known)):
        near = difflib.get_close_matches(name, known, 3, 0.5)
        meant = f"did you mean {', '.join(near)}?" if near else "see 'hilctl list --keys'"
        if not name.startswith(tuple(prefixes)):
            raise InputError(f"{printable(name)}: there is no such key ({printable(meant)})")
        _log.warning("no recording here has %s (%s)", printable(name), printable(meant))

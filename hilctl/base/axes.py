"""The ``axes`` section: one experiment per axis, its keys laid over those of the file."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

from hilctl.base.errors import ConfigError, ConfigProblem
from hilctl.base.formatting import did_you_mean
from hilctl.base.yaml import Document, Loc, dotted, loc_of

AXIS_NAME = "[a-z][a-z0-9_]*"
"""Pattern of the names of axes."""
MAX_AXES = 8
RUN_KEYS = {"name", "description", "labels", "sample_rate_hz", "block", "coupling", "trigger",
            "apart", "timing", "recording", "realtime"}  # fmt: skip
"""Keys of an experiment that are the same for all axes."""

_T = TypeVar("_T")
_Part = TypeVar("_Part")


def names_text(names: Sequence[str]) -> str:
    """Return names in words: ``x and y``, or ``x, y and z``."""
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def problems_of_axes(found: Mapping[str, Sequence[ConfigProblem]]) -> list[ConfigProblem]:
    """Return the problems of all axes by name: those of each axis once, others with their axis."""
    common = set.intersection(*map(set, found.values()))
    listed: dict[ConfigProblem, None] = {}
    for axis, problems in found.items():
        for each in problems:
            named = each in common or each.where.endswith(f", {axis}")
            listed[each if named else replace(each, where=f"{each.where}, {axis}")] = None
    return [*listed]


def axis_documents(document: Document) -> dict[str, Document]:
    """Return the document of each axis by name; that of an experiment without axes under "".

    Raise ConfigError if ``axes`` breaks rules.
    """
    if "axes" not in document.data:
        return {"": document}
    axes = document.data["axes"]
    if not (isinstance(axes, dict) and 2 <= len(axes) <= MAX_AXES):
        raise ConfigError([document.problem("axes", f"must hold 2 to {MAX_AXES} named axes")])
    if problems := [*_problems(document)]:
        raise ConfigError(problems)
    parts = {name: document.part(("axes", name), name) for name in axes}
    if problems := [*_shadowed(document, parts)]:
        raise ConfigError(problems)
    for part in [*parts.values()][1:]:
        part.remove("trigger")  # its marks and channels are those of the first axis
    return parts


def of_each_axis(
    parts: Mapping[str, _Part],
    made: Callable[[str, _Part], _T],
    joint: Iterable[ConfigProblem] = (),
) -> dict[str, _T]:
    """Return what a function makes of the name and part of each axis, by name.

    Raise ConfigError with the problems of all axes, after the joint ones.
    """
    found, problems = dict[str, _T](), dict[str, Sequence[ConfigProblem]]()
    for axis, part in parts.items():
        problems[axis] = ()
        try:
            found[axis] = made(axis, part)
        except ConfigError as error:
            problems[axis] = error.problems
    if every := [*joint, *problems_of_axes(problems)]:
        raise ConfigError(every)
    return found


def one_axis_document(document: Document) -> Document:
    """Return a document without axes; raise ConfigError if it has some."""
    (first, found), *others = axis_documents(document).items()
    if not others:
        return found
    names = names_text([first, *(name for name, _ in others)])
    rule = f"the experiment has the axes {names}, and this takes one"
    raise ConfigError([document.problem("axes", rule, hint=f"add --set axis={first}")])


def with_settings(document: Document, settings: Iterable[str]) -> Document:
    """Return a document with ``key=value`` texts over it.

    With ``axis=NAME`` it is that axis' own, and the other settings are those of the axis, except
    the ones of ``axes``.
    """
    others = []
    for setting in settings:
        if _loc_in(setting)[0] in {"axes", "axis"}:
            document.set(setting)
        else:
            others.append(setting)
    if "axis" in document.data:
        document = _of_axis(document)
    for setting in others:
        document.set(setting)
    return document


def _loc_in(setting: str) -> Loc:
    """Return the location of the key in a ``key=value`` text."""
    return loc_of(setting.partition("=")[0].strip())


def _of_axis(document: Document) -> Document:
    """Return the document of the chosen axis."""
    name, axes = document.data["axis"], document.data.get("axes")
    if not isinstance(axes, dict):
        raise ConfigError([document.problem("axis", "the experiment has no axes to choose from")])
    if name not in axes:
        hint = did_you_mean(str(name), list(axes))
        raise ConfigError([document.problem("axis", "must name an axis", str(name), hint)])
    document.remove("axis")
    document.remove("apart")  # of two axes
    document.remove("coupling")  # the others are at rest
    axis_documents(document)
    return document.part(("axes", name), name)  # with the trigger, also if it is not the first one


def _problems(document: Document) -> Iterator[ConfigProblem]:
    """Yield the broken rules on the names of axes and their keys."""
    for name, keys in document.data["axes"].items():
        if not re.fullmatch(AXIS_NAME, name):
            rule = "the name must be a small letter and more small letters, digits and '_'"
            yield document.problem(f"axes.{name}", rule)
        elif not isinstance(keys, dict):
            yield document.problem(f"axes.{name}", "must hold keys of the experiment")
        else:
            rule, hint = "is the same for all axes", "set it at the top of the file"
            for key in sorted(keys.keys() & RUN_KEYS):
                problem = document.problem(f"axes.{name}.{key}", rule, hint=hint)
                yield replace(problem, where=f"{problem.where}, {name}")


def _shadowed(document: Document, parts: dict[str, Document]) -> Iterator[ConfigProblem]:
    """Yield the settings without effect, because each axis sets their key."""
    for assignment in document.assignments:
        where, loc = f"setting {assignment}", _loc_in(assignment)
        places = [part.where(loc) for part in parts.values()]
        if loc[0] != "axes" and document.where(loc) == where and where not in places:
            rule, name = "has no effect, because each axis sets this key", next(iter(parts))
            hint = f"set axes.{name}.{dotted(loc)}"
            yield document.problem(dotted(loc), rule, hint=hint)

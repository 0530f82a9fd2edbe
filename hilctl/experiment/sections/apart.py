"""The ``apart`` section: an interlock on the difference of the displacements of two axes."""

from collections.abc import Iterator, Mapping, Sequence

from hilctl.base.errors import ConfigProblem, broken
from hilctl.loop.interlocks import ApartSettings
from hilctl.loop.limiter import CommandLimits


def apart_problems(apart: ApartSettings | None, axes: Sequence[str]) -> Iterator[ConfigProblem]:
    """Yield that ``apart`` does not name two axes of the run; ``axes`` is empty without any."""
    if apart is None:
        return
    if not axes:
        yield broken("apart", "needs an experiment with axes", hint="remove it")
    elif len({*apart.axes} & {*axes}) < 2:
        rule = f"must name two different axes of {', '.join(axes)}"
        yield broken("apart.axes", rule, f"[{', '.join(apart.axes)}]")


def apart_notes(apart: ApartSettings | None, limits: Mapping[str, CommandLimits]) -> Iterator[str]:
    """Yield that the safe ramp may move the two axes further apart."""
    if apart is None:
        return
    one, other = (limits[name] for name in apart.axes)
    if (one.safe, one.ramp_per_s) != (other.safe, other.ramp_per_s):
        names = " and ".join(apart.axes)
        ramps = "have different safe values or safe ramps, which may move them further apart"
        yield f"{names} {ramps}: set the same safe and range of commands for both"

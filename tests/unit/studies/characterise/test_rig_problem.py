"""A problem is one message: what was seen, and what to do."""

from hilctl.base.errors import RunError
from hilctl.studies.characterise.rig_problem import RigProblemError


def test_text_and_remedy_are_one_message():
    error = RigProblemError("no_reaction", "nothing moves", "look at the wires")
    assert isinstance(error, RunError)
    assert str(error) == "nothing moves: look at the wires"
    assert error.code == "no_reaction"

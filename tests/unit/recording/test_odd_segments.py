"""Segments that are not as hilctl writes them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilctl.base.segments import Segment
from hilctl.recording.odd_segments import understood
from hilctl.recording.segments import is_plain

GOOD = Segment("sine", 0, 100, 10, 90, 20.0).to_mapping()
VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(-1, 2**41), st.floats(), st.text(),
    st.sampled_from(["\ud800", "tab\t", 2**40, -0.0, 1e308]), st.lists(st.integers()),
)  # fmt: skip


@given(st.dictionaries(st.sampled_from([*GOOD, "more"]), VALUES))
def test_what_is_plain_is_understood_as_it_stands(change):
    """The short way lets nothing through that the long one refuses or changes."""
    each = {**GOOD, **change}
    if is_plain(each):
        assert repr(understood([each])) == repr([each])


def test_what_is_wrong_is_said_with_its_place():
    with pytest.raises(ValueError, match=r"segments: 1\.stop: Input should be a valid integer"):
        understood([GOOD, {**GOOD, "stop": "100"}])

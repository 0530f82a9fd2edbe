"""The section ``feedback``: either a bandwidth or gains."""

import pytest
from pydantic import ValidationError

from hilctl.experiment.feedback_keys import FeedbackConfig


@pytest.mark.parametrize("way", [{"bandwidth_hz": 5.0}, {"ki_per_s": 3.0},
                                 {"ki_per_s": 3.0, "kp": 0.0}])  # fmt: skip
def test_one_way_is_enough(way):
    assert FeedbackConfig(limit_um=1.0, **way).limit_um == 1.0


@pytest.mark.parametrize("ways", [{}, {"kp": 0.1}, {"bandwidth_hz": 5.0, "ki_per_s": 3.0},
                                  {"bandwidth_hz": 5.0, "kp": 0.1}])  # fmt: skip
def test_none_and_both_are_refused(ways):
    with pytest.raises(ValidationError, match="must have either bandwidth_hz or ki_per_s"):
        FeedbackConfig(limit_um=1.0, **ways)

"""What a run has skipped is filled in, as long as it is little."""

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.characterise.gaps import without_gaps


def skipping(make_recording, skipped):
    """A ramp of 1000 samples, some of which are missing."""
    index = np.delete(np.arange(1000), skipped)
    return make_recording(2.0 * index, command=1.0 * index, index=index)


def test_the_command_is_held_and_the_displacement_drawn_straight(make_recording):
    command, displacement_um = without_gaps(skipping(make_recording, [500, 501]), 100, 900)
    assert command.size == displacement_um.size == 800
    np.testing.assert_array_equal(command[398:404], [498, 499, 499, 499, 502, 503])
    np.testing.assert_allclose(displacement_um, 2.0 * np.arange(100, 900))


def test_readings_that_are_no_numbers_are_missing_too(make_recording):
    run = skipping(make_recording, [])
    run.samples.displacement_um[300] = np.nan
    np.testing.assert_allclose(without_gaps(run, 0, 1000)[1], 2.0 * np.arange(1000))


def test_too_many_are_refused(make_recording):
    with pytest.raises(DataError, match="11 of 1000 samples are missing"):
        without_gaps(skipping(make_recording, np.arange(500, 511)), 0, 1000)

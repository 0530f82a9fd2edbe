"""The signals of blocks."""

import numpy as np

from hilctl.base.samples import BlockBatch
from hilctl.live.signals import ROW, SIGNALS, traces_of


def batch():
    made = BlockBatch.empty(2, 2, 1)
    made.heads[:, 1] = (10, 14)
    made.columns[:] = np.arange(6.0)[None, :, None]
    return made


def test_error_is_displacement_less_reference_and_a_gap_stays_one():
    traces = traces_of(batch(), "um")
    assert traces.index.tolist() == [10, 11, 14, 15]
    assert traces.values[:, 0].tolist() == [0.0, 3.0, 3.0, 2.0, 4.0, 1.0]
    assert len(SIGNALS) == 6


def test_a_reference_in_another_unit_is_no_displacement():
    traces = traces_of(batch(), "A")
    assert np.isnan(traces.values[[ROW["reference"], ROW["error"]]]).all()
    assert np.isfinite(traces.values[ROW["displacement"]]).all()


def test_what_is_not_finite_is_shown_as_missing():
    made = batch()
    made.columns[0, 3, 0] = np.inf
    assert np.isnan(traces_of(made, "um").values[ROW["displacement"], 0])


def test_a_part_is_by_sample_index():
    assert traces_of(batch(), "um").part(11, 15).index.tolist() == [11, 14]

"""Signals of blocks."""

import numpy as np

from hilctl.base.samples import COLUMNS, BlockBatch
from hilctl.live.traces import ROW, SIGNALS, traces_of


def batch():
    made = BlockBatch.empty(2, 2, 1)
    made.heads[:, 1] = (10, 14)
    made.columns[:] = np.arange(float(len(COLUMNS)))[None, :, None]
    return made


def test_error_is_displacement_minus_reference():
    traces = traces_of(batch(), "um")
    assert traces.index.tolist() == [10, 11, 14, 15]
    assert traces.values[:, 0].tolist() == [0.0, 3.0, 3.0, 2.0, 4.0, 1.0]
    assert len(SIGNALS) == 6


def test_reference_in_another_unit_has_no_error():
    traces = traces_of(batch(), "A")
    assert np.isnan(traces.values[[ROW["reference"], ROW["error"]]]).all()
    assert np.isfinite(traces.values[ROW["displacement"]]).all()


def test_infinite_values_are_missing():
    made = batch()
    made.columns[0, 3, 0] = np.inf
    assert np.isnan(traces_of(made, "um").values[ROW["displacement"], 0])


def test_a_part_is_by_sample_index():
    assert traces_of(batch(), "um").part(11, 15).index.tolist() == [11, 14]

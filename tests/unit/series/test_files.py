"""Figures as files."""

from dataclasses import replace

import pytest

from hilctl.base.errors import InputError
from hilctl.series.files import applying_sheets, write_sheets


@pytest.mark.slow
def test_each_figure_is_a_file_of_each_format(crossed, tmp_path):
    few = replace(crossed, runs=crossed.runs[:3])
    folder = tmp_path / "figures"
    written = write_sheets(applying_sheets(few), folder, ["svg"], "single", overwrite=False)
    assert [path.name for path in written] == [
        "hysteresis_against_frequency.svg",
        "loops_by_frequency.svg",
    ]
    assert all(path.is_file() for path in written)
    assert all(caption.endswith(".") for caption in written.values())
    with pytest.raises(InputError, match="exists already"):
        write_sheets(applying_sheets(few), folder, ["svg"], "single", overwrite=False)


def test_no_figure_is_refused(crossed):
    nothing = replace(crossed, runs=())
    with pytest.raises(InputError, match="no completed run"):
        applying_sheets(nothing)

"""Commands about recordings: what their options mean."""

import pytest

from hilctl.cli.recordings import _column


@pytest.mark.parametrize(("text", "column"), [("3", 3), ("drive", "drive"), (None, None)])
def test_a_column_is_a_number_or_a_name(text, column):
    assert _column(text) == column

"""Names of exported functions; tests/contract/test_kinds.py compares what they compute."""

from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl.lab.model_export.model_export import export_text
from tests.published import piezo_ppi


@pytest.mark.parametrize(
    "name", ["a.txt", "2a.c", "a b.m", "ä.c", f"{'a' * 49}.c", "play_sum.c", "end.m", "double.c"]
)
def test_a_name_that_is_no_function_is_refused(name):
    with pytest.raises(InputError, match=r"\.c or \.m|letter|another"):
        export_text(piezo_ppi(), Path(name), 50_000.0)

"""Commands about recordings: what their options mean."""

import pytest

from hilctl.base.errors import InputError
from hilctl.cli.recordings import _column, recover
from hilctl.run.run_folder import base_folder


@pytest.mark.parametrize(("text", "column"), [("3", 3), ("drive", "drive"), (None, None)])
def test_a_column_is_a_number_or_a_name(text, column):
    assert _column(text) == column


def test_a_damaged_run_is_dismissed_by_its_name(capsys):
    folder = base_folder() / "sine-7"
    folder.mkdir()
    (folder / "run.json").write_text('{"started": "x"}')
    recover(given_up="sine-7")
    assert str(folder) in capsys.readouterr().out
    assert not folder.exists()


@pytest.mark.parametrize("given", [{}, {"recording": "a", "given_up": "b"}])
def test_one_of_a_recording_and_a_name_is_given(given):
    with pytest.raises(InputError, match="--dismiss NAME alone"):
        recover(**given)

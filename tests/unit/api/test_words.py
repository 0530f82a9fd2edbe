"""Errors name arguments and settings; on the command line, options."""

import pickle
from inspect import signature

import pytest

from hilctl import api
from hilctl.api.words import options_kept, reworded
from hilctl.base.errors import InputError


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("or other files with --validate", "or other files with validate"),
        ("--model staged: omit --whole", "model staged: omit the setting whole"),
        ("set --rate-hz 1e3 if", "set the setting table.rate_hz=1e3 if"),
        ("(--displacement-scale -1)", "(the setting table.displacement_scale=-1)"),
        ("fit it with --set offset=true", "fit it with the setting offset=true"),
        ("with --set table.first_row=7.", "with the setting table.first_row=7."),
        ("use hilctl identify --model field", "use hilctl identify --model field"),
        ("sudo usermod --append GROUP", "sudo usermod --append GROUP"),
    ],
)  # fmt: skip
def test_options_are_arguments_or_settings(message, expected):
    assert reworded(message, signature(api.identify).parameters) == expected


def test_an_argument_may_have_a_unit():
    arguments = signature(api.spectrum).parameters
    assert reworded("with --from and --to", arguments) == "with from_s and to_s"


def test_messages_name_options_on_the_command_line_only(tmp_path):
    table = tmp_path / "loop.csv"
    table.write_text("a,b\n1,2\n3,4\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"table\.command_column") as own:
        api.identify(table)
    assert "--" not in str(own.value)
    with options_kept(), pytest.raises(InputError, match="--command-column"):
        api.identify(table)


def test_functions_can_be_pickled():
    assert pickle.loads(pickle.dumps(api.summarize)) is api.summarize

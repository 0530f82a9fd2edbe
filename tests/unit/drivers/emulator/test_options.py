"""What to emulate: words that mean nothing are refused at once."""

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.options import EmulatorOptions


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"link": "pigeon"}, "link must be one of tcp, rtu, got 'pigeon'"),
        ({"reader_line": "other"}, "reader_line must be one of same, own, got 'other'"),
    ],
)
def test_words_that_mean_nothing_are_refused(options, words):
    """The message lists those that do."""
    with pytest.raises(InputError, match=words):
        EmulatorOptions("wago_750", **options)

"""The list of identification settings as it is printed."""

import pytest

from hilctl.cli.identify_view import print_settings
from hilctl.identify.settings import IdentifySettings


def test_every_setting_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    """The list has each setting's name, where --help says that it is."""
    print_settings()
    shown = capsys.readouterr().out
    for name in (*IdentifySettings.model_fields.keys() - {"table"}, "table.rate_hz"):
        assert f" {name} " in shown, name

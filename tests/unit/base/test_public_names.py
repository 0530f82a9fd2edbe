"""The names that devices of other packages import, and their page."""

import re
from pathlib import Path

import hilctl.base

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "device_python.md"


def test_every_public_name_is_importable_and_documented():
    shown = re.findall(r"auto\w+:: hilctl\.base\.\w+\.(\w+)", PAGE.read_text(encoding="utf-8"))
    assert sorted(shown) == sorted(hilctl.base.__all__)
    for name in hilctl.base.__all__:
        assert getattr(hilctl.base, name).__name__ == name

"""Waveforms from plain keys, as they come out of an experiment file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from hilctl.waveforms.build import Reference, build
from hilctl.waveforms.spec import AnyWaveform


@pytest.fixture(scope="session")
def made() -> Callable[..., Reference]:
    """Build a waveform from its keys; the unit is A where none is given."""
    adapter: TypeAdapter[Any] = TypeAdapter(AnyWaveform)

    def make(rate_hz: float, folder: Path = Path(), **keys: Any) -> Reference:
        return build(adapter.validate_python({"unit": "A", **keys}), rate_hz, folder)

    return make

"""A Preisach triangle in the place of the plays, between known stages."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hilctl.identify.data.records import SteadyLoop
from hilctl.models.files import dump_model, parse_model
from hilctl.models.preisach import PreisachModel
from hilctl.models.staged import FieldLag, StagedModel
from hilctl.models.structure import Structure
from tests.staged import GRID, fit

Loops = Callable[..., list[SteadyLoop]]


@pytest.mark.slow
def test_preisach_triangle_is_nearer_between_known_stages(loops_of: Loops) -> None:
    """A triangle in place of plays and deadbands meets loops whose plays bend one by one."""
    stages: dict[str, Any] = {
        "lag": FieldLag(tau_s=1e-4, growth_per_unit=0.3),
        "structure": Structure(natural_hz=2300.0, damping_ratio=0.15),
        "delay_s": 3e-5,
    }
    lines = 12
    edges = np.linspace(-7.0, 7.0, lines + 1)
    bend = 1.5 - np.tanh(edges[:-1] / 3.0)
    made = PreisachModel(
        command_span=(-7.5, 7.5),
        thresholds=tuple((0.5 * np.arange(lines)).tolist()),
        lowest=-7.0,
        cell=float(edges[1] - edges[0]),
        slopes=tuple(tuple((bend * np.exp(-0.3 * i)).tolist()) for i in range(lines)),
    )
    loops = loops_of(StagedModel.around(made, **stages), GRID)
    plays = fit(loops)
    triangle = fit(loops, hysteresis="preisach", lines=16)
    assert triangle.rms_percent < 0.5 * plays.rms_percent
    assert isinstance(triangle.model, StagedModel)
    assert triangle.model.hysteresis.kind == "preisach"
    assert triangle.standard_errors.keys() <= triangle.parameters.keys() - {"output_offset_um"}
    assert parse_model("x.yaml", dump_model(triangle.model)) == triangle.model
    inverse, rate_hz = triangle.model.inverse(75_000.0), 75_000.0
    reference_um = 8.0 * np.sin(2.0 * np.pi * 50.0 * np.arange(6000) / rate_hz)
    command = inverse.process(np.append(reference_um, np.zeros(inverse.preview))[inverse.preview :])
    back = triangle.model.forward(rate_hz).process(command)
    error = (back - reference_um)[3000 : -2 * inverse.preview]
    assert np.max(np.abs(error)) < 0.02 * 16.0

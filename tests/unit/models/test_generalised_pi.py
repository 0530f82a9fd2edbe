"""The generalised model against its definition."""

import numpy as np
import pytest

from hilctl.base.errors import ConfigError
from hilctl.models.generalised_pi import GeneralisedModel, PlayEnvelope
from hilctl.models.model_file import parse_model

RATE_HZ = 50_000.0
LOW, HIGH = SPAN = (-7.0, 8.0)
PLAIN = {"command_span": SPAN}


def test_the_generalised_model_follows_its_definition():
    """Each generalised play obeys (1.17), though the model runs them behind one signal."""
    rising = PlayEnvelope(slope=0.15, shift=0.2, level=-0.2)
    falling = PlayEnvelope(height=1.1, slope=0.14, shift=0.2, level=-0.1)
    model = GeneralisedModel(
        **PLAIN, direct=20.0, weights=(5.0, 3.0), thresholds=(0.1, 0.4), rising=rising,
        falling=falling,
    )  # fmt: skip
    rng = np.random.default_rng(3)
    v = rng.uniform(-6.0, 6.0, 200)
    low = np.tanh(0.15 * v + 0.2) - 0.2
    high = np.maximum(low, 1.1 * np.tanh(0.14 * v + 0.2) - 0.1)
    expected = np.zeros(v.size)
    for r, weight in ((0.0, 20.0), (0.1, 5.0), (0.4, 3.0)):
        held = 0.0
        for k in range(v.size):
            held = max(low[k] - r, min(high[k] + r, held))
            expected[k] += weight * held
    np.testing.assert_allclose(model.forward(RATE_HZ).process(v), expected, atol=1e-12)


def test_envelopes_must_rise():
    text = """
    model: {kind: generalised, command_span: [-6.0, 6.0], direct: 1.0, weights: [],
            thresholds: [], rising: {slope: 0.1}, falling: {slope: -0.1}}
    """
    with pytest.raises(ConfigError, match=r"falling\.slope must be > 0"):
        parse_model("here", text)

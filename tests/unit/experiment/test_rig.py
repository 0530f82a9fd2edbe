"""What the sections share of device, rate and limits."""

import pytest

from tests.unit.experiment.sections.test_limits import CURRENT, VOLTAGE, loaded


def test_rig():
    """Stroke and safe value from the file, the sensor's ends from the device."""
    made = loaded(CURRENT)
    context = made.rig.interlock_context()
    assert context.stroke_um == (-75.0, 60.0)
    assert context.sensor_um == (-125.0, 125.0)
    assert (context.unit, context.safe) == ("A", 0.5)
    assert context.frozen_travel == pytest.approx(0.02 * 14.0)


def test_in_volt():
    made = loaded(VOLTAGE, "limits.measured_deviation_v=0.3", "limits.frozen_s=0.1")
    context = made.rig.interlock_context()
    assert (context.unit, made.config.limits.measured_deviation) == ("V", 0.3)
    assert context.frozen_travel == pytest.approx(0.02 * 10.0)

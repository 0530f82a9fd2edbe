"""The output of an emulated Modbus device after power-up."""

import pytest

from tests.unit.drivers.emulator.conftest import emulated_modbus


@pytest.mark.parametrize(("name", "output", "sensor", "more", "current_a", "value"), [
    ("labjack_t7", "DAC1", "AIN0", {}, -10.0, 0.0),
    ("labjack_t8", "DAC0", "AIN0", {}, -9.80198, 0.0),
    ("labjack_t7", "DAC0", "AIN0", {"current_a": 2.0}, 2.0, 3.0),
    ("generic_float32", "OUT", "IN", {}, 0.0, 0.0),
    ("adam_6024", "AO0", "AI0", {}, 0.0, 5.0),
])  # fmt: skip
def test_powers_up_as_its_profile_says(name, output, sensor, more, current_a, value):
    device = emulated_modbus(name, output, sensor, **more)
    assert device._first.rig.command == pytest.approx(current_a, abs=5e-3)
    assert device._outputs[output].value == pytest.approx(value, abs=2e-3)

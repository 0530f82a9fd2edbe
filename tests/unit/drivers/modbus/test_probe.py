"""Reading a Modbus device: what its registers say, and nothing sent that changes them."""

import pytest

from tests.unit.drivers.modbus.test_modbus_dac import exchange


@pytest.mark.parametrize(
    ("profile", "reader"),
    [("labjack_t7", "labjack_t7"), ("adam_6224", "adam_6217"), ("adam_4024", "adam_4117")],
)
def test_input_and_output_are_read(serve, profile, reader):
    """From one device or two; nothing is put out."""
    served = serve(profile, None if reader == profile else reader)
    served.device().make_safe(3.0)
    served.clock.pass_s(0.5)
    before = served.events()
    displacement_um, output = served.device().look()
    assert output == pytest.approx(3.0, abs=0.02)
    assert 10.0 < displacement_um < 45.0
    assert served.events() == before


def test_a_command_from_before_a_trip_is_not_taken_for_the_output(serve):
    """The register keeps it; what the terminal is at is another thing."""
    served = serve("wago_750", None)
    device = served.device(watchdog={"timeout_s": 0.5})
    device.open(100.0, 1)
    device.arm()
    exchange(device, 3.0)
    device._release()
    served.clock.pass_s(0.6)
    assert served.device().look()[1] is None
    assert served.emulator.device.tripped

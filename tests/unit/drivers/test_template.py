"""Device sections to begin with: every shipped profile gives one, or says what it lacks."""

import pytest

from hilctl.base.errors import InputError
from hilctl.experiment.devices import device_class
from hilctl_drivers.profile import load_profile, shipped_profiles
from hilctl_drivers.template import starting_section

ALONE = [
    name
    for name in shipped_profiles()
    if (each := load_profile(name)).outputs and each.sensor_inputs
]


def made(section):
    chosen = device_class(section.values["kind"])
    options = {key: value for key, value in section.values.items() if key != "kind"}
    return chosen(chosen.Options.model_validate(options)).info


@pytest.mark.parametrize("name", ALONE)
def test_a_device_can_be_made_of_it(name):
    """Its range is even about 0 A, so that limits can be; and what is asked stands in it."""
    section = starting_section(name, "A", None)
    info = made(section)
    assert info.command_unit == "A"
    assert info.command_min == pytest.approx(-info.command_max)
    for key in section.asked:
        value = section.values
        for part in key.split("."):
            value = value[part]
        assert value is not None


@pytest.mark.parametrize(("name", "reader", "line"), [
    ("kepco_bop", "agilent_34970a", "own"),
    ("kepco_bop", "capancdt_6200", "own"),
    ("adam_6224", "adam_6217", "own"),
    ("icp_m7024", "icp_m7017", "same"),
])  # fmt: skip
def test_the_sensor_may_be_on_another_device(name, reader, line):
    section = starting_section(name, "A", reader)
    made(section)
    placed = {"host", "serial_port"} & section.values["reader"].keys()
    assert bool(placed) == (line == "own")


def test_a_port_that_only_a_shared_host_needs_is_marked():
    section = starting_section("adam_6224", "A", "adam_6217")
    assert (section.values["tcp_port"], section.values["reader"]["tcp_port"]) == (502, 503)
    assert section.remarks["reader.tcp_port"].startswith("set: 502")
    assert "tcp_port" not in section.remarks


@pytest.mark.parametrize(("name", "reader", "marked"), [
    ("icp_m7024", "icp_m7017", True), ("labjack_t7", None, False),
])  # fmt: skip
def test_a_value_that_the_device_stores_is_marked(name, reader, marked):
    remarks = starting_section(name, "A", reader).remarks
    assert ("watchdog.safe_command" in remarks) == marked


def test_a_position_that_begins_at_zero_rests_in_the_middle():
    section = starting_section("kepco_bop", "A", "capancdt_6200")
    assert section.values["sensor"] == {"offset_um": -100.0}
    assert starting_section("pi_e727", "V", None).values["sensor"] == {"offset_um": 0.0}


def test_another_output_and_input_can_be_chosen():
    section = starting_section("labjack_t7", "A", None, {"output": "TDAC0", "input": "AIN2"})
    assert (section.values["output"], section.values["input"]) == ("TDAC0", "AIN2")
    assert section.values["amplifier"]["offset_a"] == 0.0
    with pytest.raises(InputError, match=r"device\.output must be one of DAC0.*'AO0'"):
        starting_section("labjack_t7", "A", None, {"output": "AO0"})


def test_a_voltage_begins_at_zero():
    section = starting_section("labjack_t7", "V", None)
    assert (made(section).command_unit, made(section).command_min) == ("V", 0.0)


@pytest.mark.parametrize(
    ("name", "rule"),
    [("adam_6224", "has no input for a displacement sensor"), ("adam_6217", "has no output")],
)
def test_half_a_device_says_what_it_lacks(name, rule):
    with pytest.raises(InputError, match=rf"{rule}.*--reader"):
        starting_section(name, "A", None)

"""What is emulated for an experiment: its profiles and its wiring, and how to run it there."""

from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.experiment_rig import is_experiment, wired_experiment
from hilctl_drivers.emulator.factory import build
from hilctl_drivers.emulator.rig import SimulatedWiring
from hilctl_drivers.profile import FOLDER

CONFIGS = Path(__file__).parents[4] / "configs"


def test_an_experiment_is_told_from_a_profile(tmp_path):
    assert is_experiment(str(CONFIGS / "modbus_labjack_t7.yaml"))
    assert not is_experiment(str(FOLDER / "labjack_t7.yaml"))
    assert not is_experiment("labjack_t7")
    assert not is_experiment(str(tmp_path / "absent.yaml"))


def test_it_has_the_wiring_of_the_experiment():
    wired = wired_experiment(CONFIGS / "modbus_labjack_t7.yaml")
    assert wired.options.wiring == SimulatedWiring(4.0, -10.0, 12.5, 0.0)
    assert (wired.options.port, wired.options.link) == (5020, "tcp")
    assert wired.wiring() == [
        "DAC0: current = 4 A x output -10 A",
        "AIN0: displacement = 12.5 µm x input +0 µm",
    ]


def test_a_reader_has_its_own_place():
    options = wired_experiment(CONFIGS / "modbus_adam_6224.yaml").options
    assert (options.reader, options.reader_line, options.reader_port) == ("adam_6217", "own", 5021)
    options = wired_experiment(CONFIGS / "serial_scpi_kepco.yaml").options
    assert (options.reader, options.reader_line) == ("agilent_34970a", "own")


def test_the_command_names_what_is_elsewhere():
    path = CONFIGS / "serial_scpi_kepco.yaml"
    wired = wired_experiment(path)
    emulator = build(wired.options)
    try:
        words = wired.words(emulator)
    finally:
        emulator.server.close()
        emulator.log.close()
    assert words[:2] == ["run", str(path)]
    assert f"device.serial_port={emulator.address}" in words
    assert f"device.reader.serial_port={emulator.reader_address}" in words
    assert len(words) == 6


def test_a_port_that_no_user_may_listen_on_is_another_one(tmp_path):
    text = (
        (CONFIGS / "modbus_labjack_t7.yaml").read_text().replace("tcp_port: 5020", "tcp_port: 502")
    )
    path = tmp_path / "real.yaml"
    path.write_text(text)
    wired = wired_experiment(path)
    assert wired.options.port == 0
    emulator = build(wired.options)
    try:
        port = emulator.address.rpartition(":")[2]
        assert wired.words(emulator) == ["run", str(path), "--set", f"device.tcp_port={port}"]
    finally:
        emulator.server.close()
        emulator.log.close()


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ("{kind: simulated_piezo}", "must name a profile"),
        ("{kind: modbus_dac, profile: labjack_t7, host: h, output: DAC0, input: AIN0,"
         " amplifier: {gain_v_per_v: 1.0}, sensor: {um_per_v: 1.0}, watchdog: none}",
         "driven with a current"),
        ("{kind: modbus_dac, profile: labjack_t7, hots: h}", r"x.yaml:1: device.hots: unknown key"),
    ],
)  # fmt: skip
def test_what_has_no_emulator_says_why(tmp_path, section, said):
    path = tmp_path / "x.yaml"
    path.write_text(f"device: {section}\n")
    with pytest.raises(InputError, match=said):
        wired_experiment(path)

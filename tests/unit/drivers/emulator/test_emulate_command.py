"""The command: words, places, and its end by a signal."""

import json
import re
import signal
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hilctl.base.errors import InputError
from hilctl.cli.commands import app
from hilctl_drivers.emulator.emulate_command import serve, wired_experiment
from hilctl_drivers.emulator.factory import build
from hilctl_drivers.emulator.options import EmulatorOptions, RigOptions, parse_fault
from hilctl_drivers.emulator.server import EmulatorServer

CONFIGS = Path(__file__).parents[4] / "configs"


@pytest.mark.parametrize(("profile", "reader", "options", "places"), [
    ("adam_4024", "adam_4117", {}, r"(/dev/pts/\d+) unit 1 \1 unit 2"),
    ("adam_4024", "adam_4117", {"reader_unit_id": 7}, r"(/dev/\S+) unit 1 \1 unit 7"),
    ("adam_6224", "adam_6217", {}, r"127.0.0.1:(\d+) unit 1 127.0.0.1:(?!\1)\d+ unit 1"),
    ("kepco_bop", "agilent_34970a", {}, r"(/dev/pts/\d+) (?!\1)/dev/pts/\d+"),
])  # fmt: skip
def test_it_says_where_both_answer(profile, reader, options, places):
    told = []

    def on_ready(emulators):
        told.extend(place for each in emulators for place in each.places)
        signal.raise_signal(signal.SIGTERM)

    serve([EmulatorOptions(profile, reader=reader, **options)], on_ready)
    assert [each.profile for each in told] == [profile, reader]
    said = (f"{each.address}" + f" unit {each.unit_id}" * bool(each.unit_id) for each in told)
    assert re.fullmatch(places, " ".join(said))


@pytest.fixture
def ended_at_once(monkeypatch):
    """Let a signal end each emulator as soon as it answers."""
    run = EmulatorServer.run

    def run_shortly(server):
        signal.raise_signal(signal.SIGTERM)
        run(server)

    monkeypatch.setattr(EmulatorServer, "run", run_shortly)


def test_a_program_reads_where_and_how(ended_at_once):
    path = str(CONFIGS / "serial_scpi_kepco.yaml")
    (line,) = CliRunner().invoke(app, ["emulate", path, "--json"]).stdout.splitlines()
    said = json.loads(line)
    assert [each["profile"] for each in said["devices"]] == ["kepco_bop", "agilent_34970a"]
    places = [each["address"] for each in said["devices"]]
    assert all(place.startswith("/dev/pts/") for place in places)
    assert said["wiring"] == {
        "output": "current", "input": "AI101",
        "gain_a": 1.0, "offset_a": 0.0, "sensor_um": 12.5, "offset_um": 0.0,
    }  # fmt: skip
    assert said["arguments"] == [
        "run", path,
        "--set", f"device.serial_port={places[0]}",
        "--set", f"device.reader.serial_port={places[1]}",
    ]  # fmt: skip
    shown = CliRunner().invoke(app, ["emulate", path]).stdout.splitlines()
    assert re.fullmatch(r"kepco_bop answers at /dev/pts/\d+", shown[0])
    assert "current: current = 1 A x output +0 A" in shown
    assert shown[-1].startswith(f"hilctl run {path} --set device.serial_port=/dev/pts/")


def test_a_profile_alone_is_driven_with_either_unit(ended_at_once):
    command = ["emulate", "labjack_t7", "--json"]
    said = json.loads(CliRunner().invoke(app, command).stdout)
    assert (said["devices"][0]["unit_id"], "arguments" in said) == (None, False)
    assert (said["wiring"]["gain_a"], said["wiring"]["offset_a"]) == (4.0, -10.0)
    said = json.loads(CliRunner().invoke(app, [*command, "--unit", "V"]).stdout)
    assert (said["wiring"]["gain_v"], said["wiring"]["sensor_um"]) == (20.0, 5.0)


@pytest.mark.parametrize("words", [
    ["kepco_bop", "--reader", "agilent_34970a", "--sensor", "AI102"],
    ["kepco_bop", "--sensor", "agilent_34970a:AI102"],
])  # fmt: skip
def test_options_become_the_emulator(words, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "hilctl_drivers.emulator.emulate_command.serve", lambda *of: asked.append(of[0])
    )
    log = tmp_path / "log.jsonl"
    more = ["--log", str(log), "--fault", "cut@2", "--fault", "delay:0.3@1s", "--port", "5020"]
    ended = CliRunner().invoke(app, ["emulate", *words, *more])
    assert ended.exit_code == 0, ended.output
    made = EmulatorOptions(
        "kepco_bop",
        port=5020,
        log=log,
        faults=(parse_fault("cut@2"), parse_fault("delay:0.3@1s")),
        reader="agilent_34970a",
        rigs=(RigOptions(sensor="AI102"),),
    )
    assert asked == [[made]]


def test_it_has_the_amplifier_of_the_experiment(tmp_path):
    limit = "amplifier: {voltage_max_v: 36, resistance_ohm: 4, inductance_h: 0.003}\n"
    path = tmp_path / "rig.yaml"
    path.write_text(limit + (CONFIGS / "modbus_labjack_t7.yaml").read_text())
    (options,) = wired_experiment(path).options
    assert options.rigs[0].actuator.amplifier.voltage_max_v == 36.0
    assert options.rigs[0].limits == (-7.07, 7.07)


T8_PIEZO = """\
device:
  kind: modbus_dac
  profile: labjack_t8
  host: 127.0.0.1
  output: DAC0
  input: AIN0
  amplifier: {gain_v_per_v: 10.0}
  sensor: {um_per_v: 5.0}
  watchdog: none
"""


def test_an_experiment_in_volts_has_a_piezo(ended_at_once, tmp_path):
    path, log = tmp_path / "piezo.yaml", tmp_path / "log.jsonl"
    path.write_text(T8_PIEZO)
    command = ["emulate", str(path), "--json", "--actuator", "seed=7", "--current-a", "30"]
    said = json.loads(CliRunner().invoke(app, [*command, "--log", str(log)]).stdout)
    assert said["wiring"] == {
        "output": "DAC0", "input": "AIN0",
        "gain_v": 10.0, "offset_v": 0.0, "sensor_um": 5.0, "offset_um": 0.0,
    }  # fmt: skip


AXES = """\
device: {kind: modbus_dac, profile: labjack_t8, host: 127.0.0.1, watchdog: none,
  amplifier: {gain_v_per_v: 10.0}, sensor: {um_per_v: 5.0}}
limits: {drive_v: [0.0, 50.0]}
axes:
  x: {device: {output: DAC0, input: AIN1}}
  y: {device: {output: DAC1, input: AIN0}, limits: {drive_v: [0.0, 100.0]}}
"""


def said_of(path, *words):
    """Return what the emulator says of an experiment with axes, and the settings to run it."""
    ended = CliRunner().invoke(app, ["emulate", str(path), "--json", *words])
    assert ended.exit_code == 0, ended.exception
    said = json.loads(ended.stdout)
    start, name, *words = said.pop("arguments")
    assert (start, name, set(words[::2])) == ("run", str(path), {"--set"})
    return said, words[1::2]


class TestAxes:
    @pytest.fixture
    def path(self, tmp_path, ended_at_once):
        path = tmp_path / "stage.yaml"
        path.write_text(AXES)
        return path

    def test_axes_on_one_device_have_a_rig_each(self, path):
        (options,) = wired_experiment(path, actuator=["axes.y.sensor_noise_um=0.1"]).options
        x, y = options.rigs
        assert [(each.output, each.sensor) for each in (x, y)] == [
            ("DAC0", "AIN1"), ("DAC1", "AIN0"),
        ]  # fmt: skip
        assert (x.limits, y.limits) == ((0.0, 50.0), (0.0, 100.0))
        assert x.actuator.seed != y.actuator.seed
        assert (x.actuator.sensor_noise_um, y.actuator.sensor_noise_um) == (1e-3, 0.1)
        said, settings = said_of(path)
        (port,) = (each["address"].rpartition(":")[2] for each in said["devices"])
        assert {axis: each["output"] for axis, each in said["wiring"].items()} == {
            "x": "DAC0", "y": "DAC1",
        }  # fmt: skip
        assert settings == [f"axes.{axis}.device.tcp_port={port}" for axis in "xy"]

    def test_axes_on_several_devices_are_served_together(self, path):
        said, settings = said_of(path, "--set", "axes.y.device.host=localhost")
        assert len({each["address"] for each in said["devices"]}) == 2
        first, second = (each["address"].rpartition(":")[2] for each in said["devices"])
        assert settings == [
            "axes.y.device.host=localhost",
            f"axes.x.device.tcp_port={first}",
            "axes.y.device.host=127.0.0.1",
            f"axes.y.device.tcp_port={second}",
        ]

    def test_a_place_of_all_axes_is_replaced(self, path):
        words = ["--set", "device.tcp_port=502", "--set", "name=other"]
        said, settings = said_of(path, *words)
        port = said["devices"][0]["address"].rpartition(":")[2]
        assert settings == [
            "name=other", f"axes.x.device.tcp_port={port}", f"axes.y.device.tcp_port={port}",
        ]  # fmt: skip

    def test_one_axis_is_emulated_alone(self, path):
        said, settings = said_of(path, "--set", "axis=y")
        assert said["wiring"]["output"] == "DAC1"
        assert settings[0] == "axis=y"
        assert settings[1].startswith("device.tcp_port=")

    @pytest.mark.parametrize(("words", "key"), [
        (["--actuator", "axes.z.seed=2"], "axes: must hold options of x and y"),
        (["--actuator", "axes.y.sed=2"], "--actuator axes.y.sed=2, y: sed: unknown key"),
        (["--set", "axes.y.device.output=DAC0"], "DAC0 must not have two rigs"),
        (["--set", "axes.y.device.profile=3"], "y: device.profile: must name a profile"),
        (["--output", "DAC0"], "--output"),
    ])  # fmt: skip
    def test_what_does_not_fit_is_refused(self, path, words, key):
        ended = CliRunner().invoke(app, ["emulate", str(path), *words])
        assert ended.exit_code != 0
        assert key in str(ended.exception)


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (["--actuator", "physics=plays"], "delete the key"),
        (["--actuator", "fault.kind=refused", "--actuator", "output_at_open=1"], "output_at_open"),
        (["--actuator", "seed"], "--actuator seed"),
        (["--unit", "V"], "--unit"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, words, key):
    path = tmp_path / "piezo.yaml"
    path.write_text(T8_PIEZO)
    ended = CliRunner().invoke(app, ["emulate", str(path), *words])
    assert ended.exit_code != 0
    assert key in str(ended.exception)


def test_a_port_that_no_user_may_listen_on_is_another_one(tmp_path):
    text = (
        (CONFIGS / "modbus_labjack_t7.yaml").read_text().replace("tcp_port: 5020", "tcp_port: 502")
    )
    path = tmp_path / "real.yaml"
    path.write_text(text)
    wired = wired_experiment(path)
    (options,) = wired.options
    assert options.port == 0
    emulator = build(options)
    try:
        port = emulator.address.rpartition(":")[2]
        assert wired.words([emulator]) == ["run", str(path), "--set", f"device.tcp_port={port}"]
    finally:
        emulator.server.close()
        emulator.log.close()


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ("{kind: simulated_piezo}", "must name a profile"),
        ("{kind: modbus_dac, profile: labjack_t7, hots: h}", r"x.yaml:1: device.hots: unknown key"),
    ],
)  # fmt: skip
def test_what_has_no_emulator_says_why(tmp_path, section, said):
    path = tmp_path / "x.yaml"
    path.write_text(f"device: {section}\n")
    with pytest.raises(InputError, match=said):
        wired_experiment(path)

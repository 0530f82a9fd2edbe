"""Probing a device: it is only read, and its answers are evaluated."""

import math
import re
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import DeviceError, InputError
from hilctl.base.yaml import dump
from hilctl.experiment.devices import device_class
from hilctl.run.probe import judge, probe
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.profile import shipped_profiles
from hilctl_drivers.simulated.devices import TerfenolOptions
from tests.fakes import ManualClock, emulated, held_devices, logged, one_rig

CONFIGS = Path(__file__).parents[3] / "configs"
INFO = DeviceInfo(
    name="dac", description="a DAC", command_unit="A", command_min=-10.0, command_max=10.0,
    sensor_min_um=-125.0, sensor_max_um=125.0, max_rate_hz=1000.0,
)  # fmt: skip


@pytest.mark.parametrize(("displacement_um", "output", "faults"), [
    (3.0, 0.0, []),
    (None, None, []),
    (-125.1, 10.01, []),
    (2.8e20, 0.0, ["displacement must be -125 to 125 um, .* got 2.8e.20 um .*order .ABCD, CD"]),
    (math.nan, 0.0, ["displacement .* got nan um .*order"]),
    (150.0, 0.0, ["displacement .* got 150 um .compare scale, offset and range"]),
    (3.0, -math.inf, ["output must be -10 to 10 A, .* got -inf A .*order"]),
    (1e-30, 0.0, ["displacement must be 0 or more .* got 1e-30 um .*order"]),
    (1e-14, -1e-15, []),
    (-200.0, 12.0, ["displacement", "output .* got 12 A .compare scale"]),
])  # fmt: skip
def test_implausible_readings_are_reported_with_a_likely_cause(displacement_um, output, faults):
    found = judge(INFO, displacement_um, output)
    assert len(found) == len(faults)
    for fault, text in zip(found, faults, strict=True):
        assert re.search(text, fault), fault


def test_a_simulated_device_is_opened_and_closed():
    found = probe(CONFIGS / "demo.yaml", [])[""]
    assert found.name == "simulated_terfenol"
    assert found.displacement_um is None
    assert found.faults == ()
    assert found.max_rate_hz > 0.0


class ProbedRig:
    """An emulated device, what it put out, and an experiment on it."""

    def __init__(self, emulator, clock, folder, **device):
        self.emulator, self.clock, self.log = emulator, clock, folder / "writes.jsonl"
        kind = "modbus_dac" if "host" in emulator.options else "serial_dac"
        self.device = {**emulator.options, "kind": kind, "timeout_s": 20.0, **device}
        self.experiment = folder / "probed.yaml"
        section = {
            "name": "probed",
            "device": self.device,
            "sample_rate_hz": 10,
            "waveform": {"kind": "hold", "unit": "A", "level": 0.0, "duration_s": 1.0},
            "compensator": "none",
            "limits": {"peak_current_a": 5.0, "slew_a_per_s": 500.0, "stroke_um": [-100.0, 100.0]},
            "safe": {"value": 0.0, "ramp_s": 0.2},
        }
        self.experiment.write_text(yaml.safe_dump(section), encoding="utf-8")

    def drive(self, command):
        """Apply a command and crash: nothing is disarmed or closed."""
        chosen = device_class(self.device["kind"])
        section = {key: value for key, value in self.device.items() if key != "kind"}
        device = chosen(chosen.Options.model_validate(section))
        device.open(10.0, 1)
        device.arm()
        device.exchange(0, np.array([command]), np.empty(1), np.empty(1))
        device._release()


@pytest.fixture
def rig(tmp_path):
    """Return a function that puts an emulated device and an experiment on it together."""
    with ExitStack() as stack:

        def of(profile, reader=None, **device):
            text = shipped_profiles()[profile].read_text(encoding="utf-8")
            path = tmp_path / "profile.yaml"
            path.write_text(text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"), encoding="utf-8")
            clock = ManualClock()
            wanted = EmulatorOptions(
                str(path),
                log=tmp_path / "writes.jsonl",
                reader=reader,
                rigs=one_rig(actuator=TerfenolOptions(noise=False)),
            )
            emulator = stack.enter_context(emulated(wanted, clock))
            return ProbedRig(emulator, clock, tmp_path, **device)

        yield of


@pytest.mark.parametrize("profile", ["wago_750", "cobs_board"])
def test_probe_keeps_a_tripped_watchdog_tripped(rig, profile):
    probed = rig(profile, watchdog={"timeout_s": 0.5})
    probed.drive(3.0)
    probed.clock.pass_s(1.0)
    found = probe(probed.experiment, [])[""]
    assert probed.emulator.device.tripped
    assert found.tripped
    events = logged(probed.log)
    current_a = [each["current_a"] for each in events if "current_a" in each]
    assert current_a[-2:] == [pytest.approx(3.0, abs=1e-2), 0.0]
    assert events[-1]["event"] == "watchdog"
    assert found.output in {None, 0.0}
    assert found.faults == ()


@pytest.mark.parametrize("profile", ["labjack_t7", "agilent_34970a"])
def test_reading_and_output_are_those_of_the_rig(rig, profile):
    probed = rig(profile)
    probed.drive(3.0)
    probed.clock.pass_s(0.5)
    writes = probed.log.read_text()
    found = probe(probed.experiment, [])[""]
    assert found.output == pytest.approx(3.0, abs=1e-2)
    assert found.displacement_um == pytest.approx(20.0, abs=10.0)
    assert found.measured is None
    assert probed.log.read_text() == writes


def test_a_measured_output_is_read_too(rig):
    probed = rig("kepco_bop", reader="agilent_34970a", measure="current")
    probed.drive(3.0)
    assert probe(probed.experiment, [])[""].measured == pytest.approx(3.0, abs=1e-2)


@pytest.mark.parametrize("query", ["readback", "error_query"])
def test_a_wrong_query_of_the_output_is_found(rig, query):
    """A run sends this query only at its end."""
    probed = rig("kepco_bop", reader="agilent_34970a", measure="current")
    profile = Path(probed.device["profile"])
    data = yaml.safe_load(profile.read_text(encoding="utf-8"))
    section = data["outputs"]["current"] if query == "readback" else data
    section[query] |= {"pattern": "A([0-9])", "example": "A1"}
    profile.write_text(dump(data), encoding="utf-8")
    with pytest.raises(DeviceError, match=re.escape(section[query]["ask"])):
        probe(probed.experiment, [])


def test_a_wrong_word_order_is_found(rig):
    probed = rig("labjack_t7")
    # 1.6 V, 3fcccccd: with its words the other way round -1.08e8 V.
    probed.emulator.rigs[0].rig.displacement_um = 20.0
    assert probe(probed.experiment, [])[""].displacement_um == pytest.approx(20.0)
    profile = Path(probed.device["profile"])
    text = profile.read_text(encoding="utf-8")
    before = "AIN0: {address: 0, type: float32,"
    assert before in text
    profile.write_text(text.replace(before, before + " order: CDAB,"), encoding="utf-8")
    found = probe(probed.experiment, [])[""]
    assert found.displacement_um == pytest.approx(-1.345e9, rel=1e-3)
    (fault,) = found.faults
    assert fault.startswith("displacement must be")
    assert "compare order" in fault


def test_a_device_that_a_run_holds_is_not_disturbed(rig):
    """Many devices accept only one connection, which the run would lose."""
    probed = rig("labjack_t7")
    place = f"tcp:127.0.0.1:{probed.device['tcp_port']}"
    with held_devices([place]), pytest.raises(InputError, match="in use"):
        probe(probed.experiment, [])


STAGE = """
name: stage
sample_rate_hz: 1000
waveform: {kind: hold, unit: A, level: 0.0, duration_s: 1.0}
compensator: none
limits: {peak_current_a: 5.0, slew_a_per_s: 500.0, stroke_um: [-100.0, 100.0]}
device: {kind: simulated_terfenol}
axes: {x: {}, y: {}}
"""


def test_every_axis_is_probed(tmp_path):
    path = tmp_path / "stage.yaml"
    path.write_text(STAGE, encoding="utf-8")
    assert {name: each.name for name, each in probe(path, []).items()} == {
        "x": "simulated_terfenol",
        "y": "simulated_terfenol",
    }
    assert [*probe(path, ["axis=y"])] == [""]


def test_axes_whose_devices_do_not_answer_are_named(tmp_path, monkeypatch):
    def read(loaded, device):
        if loaded.axis == "y":
            raise DeviceError("no answer")
        return None, None, math.nan, False

    monkeypatch.setattr("hilctl.run.probe._read", read)
    path = tmp_path / "stage.yaml"
    path.write_text(STAGE, encoding="utf-8")
    with pytest.raises(DeviceError, match=r"^y: no answer$"):
        probe(path, [])

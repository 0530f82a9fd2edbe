"""What is put together, and what is refused before anything is served."""

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.options import RigOptions, WireFault
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.profile import load_profile, shipped_profiles
from hilctl_drivers.signal_chain import Amplifier, Sensor
from hilctl_drivers.simulated.devices import PiezoOptions, TerfenolOptions
from tests.fakes import one_rig
from tests.unit.drivers.emulator.conftest import MS

PAIR = {"reader": "adam_4117"}
DRIVING = [name for name in shipped_profiles() if load_profile(name).outputs]


@pytest.mark.parametrize("name", DRIVING)
@pytest.mark.parametrize("actuator", [TerfenolOptions(), PiezoOptions()])
def test_every_profile_drives_every_actuator(emulate, name, actuator):
    profile, reader = load_profile(name), None
    if not profile.sensor_inputs:
        reader = "adam_4117" if isinstance(profile, ModbusProfile) else "agilent_34970a"
    in_a = next(iter(profile.outputs.values())).unit == "A"
    if in_a and isinstance(actuator, PiezoOptions):
        with pytest.raises(InputError, match="use --unit A"):
            emulate(name, reader=reader, actuator=actuator)
        return
    made = emulate(name, reader=reader, actuator=actuator).emulator
    info, low, high = made.rigs[0].rig.actuator.info, *made.rigs[0].wiring.command_range
    assert in_a or (low, high) == pytest.approx((info.command_min, info.command_max))


@pytest.mark.parametrize(
    ("gain", "offset_v", "um_per_v", "low_v", "high_v"),
    [(15.0, 0.0, 2.0, -1.5, 150.0), (-20.0, 100.0, -4.0, -100.0, 102.0)],
)
def test_a_piezo_is_scaled_to_its_wiring(emulate, gain, offset_v, um_per_v, low_v, high_v):
    wiring = Amplifier(gain_v_per_v=gain, offset_v=offset_v), Sensor(um_per_v=um_per_v)
    made = emulate("labjack_t8", actuator=PiezoOptions(noise=False), wiring=wiring, command=0.0)
    info, rig = made.emulator.rigs[0].rig.actuator.info, made.emulator.rigs[0].rig
    assert (info.command_min, info.command_max) == (low_v, high_v)
    rig.put_out(high_v, made.now_ns)
    rig.stage.advance(made.now_ns + 10 * MS)
    assert rig.displacement_um == pytest.approx(0.8 * 10.0 * abs(um_per_v), rel=0.01)


def test_the_limits_rate_the_actuator(emulate):
    strokes_um = []
    for actuator, limits in [
        (TerfenolOptions(noise=False), (-0.5, 0.5)),
        (TerfenolOptions(noise=False, rated_current_a=7.07), (-0.5, 0.5)),
        (PiezoOptions(noise=False), (0.0, 20.0)),
    ]:
        gain = f"gain_{'v' if isinstance(actuator, PiezoOptions) else 'a'}_per_v"
        wiring = Amplifier.model_validate({gain: 10.0}), Sensor(um_per_v=5.0)
        made = emulate("labjack_t8", actuator=actuator, wiring=wiring, limits=limits, command=0.0)
        made.emulator.rigs[0].rig.put_out(limits[1], made.now_ns)
        made.emulator.rigs[0].rig.stage.advance(made.now_ns + 10 * MS)
        strokes_um.append(made.emulator.rigs[0].rig.displacement_um)
    rated_um, published_um, piezo_um = strokes_um
    assert rated_um > 10.0 * published_um
    assert piezo_um == pytest.approx(0.8 * 50.0, rel=0.01)


@pytest.mark.parametrize(("um_per_v", "stroke_um"), [(1.0, (7.9, 8.1)), (100.0, (30.0, 100.0))])
def test_rods_keep_to_the_range_of_the_sensor(emulate, um_per_v, stroke_um):
    """They move less with a smaller range, and not more with a larger one."""
    wiring = Amplifier(gain_a_per_v=1.0), Sensor(um_per_v=um_per_v)
    made = emulate("labjack_t7", wiring=wiring, limits=(0.0, 2.0), command=0.0)
    rig = made.emulator.rigs[0].rig
    rig.put_out(2.0, made.now_ns)
    rig.stage.advance(made.now_ns + 100 * MS)
    low, high = stroke_um
    assert low < rig.displacement_um < high


@pytest.mark.parametrize(("profile", "options", "words"), [
    ("waveshare_ao_8ch", {}, "has no input to show a displacement at: name a reader"),
    ("waveshare_ai_8ch", {}, "has no output to drive .*: it can be another one's reader"),
    ("adam_4024", {"reader": "kepco_bop"}, "Kepco .* has no input to show a displacement at"),
    ("kepco_bop", {"reader": "labjack_t7", "reader_line": "same"}, "cannot share the line"),
    ("kepco_bop", {"reader": "agilent_34970a", "reader_unit_id": 2}, "is for Modbus"),
    ("cobs_board", {"command": 1.0}, "is for Modbus"),
    ("icp_m7024_dcon", {}, "has no input to show a displacement at: name a reader"),
    ("nothing", {}, "no profile 'nothing' is shipped"),
    ("cobs_board", {"faults": (WireFault("reset", at_count=1),)}, "is for tcp"),
    ("adam_4024", PAIR | {"rigs": one_rig(sensor="AI9")}, "4117 .* has no AI9: AI0, AI1"),
    ("adam_4024", PAIR | {"rigs": one_rig(output="AI0")}, "4024 .* has no AI0: AO0, AO1"),
    ("adam_4024", {"reader": "adam_4117", "reader_unit_id": 1}, "reader_unit_id must not"),
    ("wago_750", {"link": "rtu", "faults": (WireFault("reset", at_count=1),)}, "is for tcp"),
])  # fmt: skip
def test_what_can_not_be_emulated_is_refused(served, profile, options, words):
    with pytest.raises(InputError, match=words):
        served(profile, **options)


AXIS = """
  axis1:
    write: "SVA 1 {value:.4f}"
    reply: none
    readback: {ask: "SVA? 1", pattern: "1=([-+]?[0-9]+[.][0-9]+)", example: "1=10.0000"}
    unit: V
    min: 0.0
    max: 100.0
    resolution: 1.0e-3"""
POSITION = """
  position1: {ask: "POS? 1", pattern: "1=([-+]?[0-9]+[.][0-9]+)", example: "1=12.3456", unit: um,
    min: -50.0, max: 50.0}"""
GCS = f"""\
vendor: nobody
model: two axes
source: [this test]
verified: "yes"
link: {{kind: ascii_tcp, port: 50000, terminator: "\\n", reply_terminator: "\\n"}}
address: none
exchange: none
turnaround_s: 0.002
max_rate_hz: 100.0
watchdog: none
outputs:{AXIS}{AXIS.replace("1", "2").replace("2.0e-3", "1.0e-3").replace("200.0", "100.0")}
inputs:{POSITION}{POSITION.replace("1", "2")}
"""


@pytest.mark.parametrize(("profile", "reader", "outputs", "sensors"), [
    ("labjack_t7", None, ("DAC0", "DAC1"), ("AIN0", "AIN1")),
    ("adam_6224", "adam_6217", ("AO1", "AO0"), ("AI3", "AI0")),
    ("gcs.yaml", None, ("axis1", "axis2"), ("position1", "position2")),
    ("adam_6224", "gcs.yaml", ("AO0", "AO1"), ("position1", "position2")),
])  # fmt: skip
def test_each_output_moves_its_own_rig(emulate, tmp_path, profile, reader, outputs, sensors):
    (tmp_path / "gcs.yaml").write_text(GCS)
    profile, reader = (
        str(tmp_path / name) if name == "gcs.yaml" else name for name in (profile, reader)
    )
    terminals = zip(outputs, sensors, strict=True)
    still = PiezoOptions(noise=False)
    rigs = tuple(
        RigOptions(*each, still, axis=axis) for axis, each in zip("xy", terminals, strict=True)
    )
    made = emulate(profile, reader=reader, rigs=rigs)
    emulator, shown = made.emulator, made.emulator.reader
    emulator.device._set_terminal(outputs[1], 4.0, "write", made.now_ns)
    shown.tick(made.now_ns + 100 * MS)
    x_um, y_um = (each.rig.displacement_um for each in emulator.rigs)
    assert x_um == pytest.approx(0.0, abs=0.01)
    assert y_um > 0.5
    read = [shown._reading(name, shown.profile.inputs[name]) for name in sensors]
    assert read == [
        float(each.wiring.at_terminal(each.rig.displacement_um)) for each in emulator.rigs
    ]
    sections = emulator.sections
    assert tuple(each["output"] for each in sections) == outputs
    assert tuple(each["input"] for each in sections) == sensors
    (write,) = made.writes()
    assert (write["output"], write["axis"]) == (outputs[1], "y")
    assert write["drive_v"] == emulator.rigs[1].rig.command


@pytest.mark.parametrize("second", [("DAC0", "AIN1"), ("DAC1", "AIN0")])
def test_a_terminal_has_one_rig(emulate, second):
    rigs = RigOptions("DAC0", "AIN0"), RigOptions(*second)
    with pytest.raises(InputError, match="must not have two rigs"):
        emulate("labjack_t7", rigs=rigs)


def test_crosstalk_is_of_the_same_device(emulate):
    seen = PiezoOptions(crosstalk={"z": {"gain": 0.1}})
    rigs = RigOptions("DAC0", "AIN0", seen, axis="x"), RigOptions("DAC1", "AIN1", axis="y")
    with pytest.raises(InputError, match="crosstalk of z"):
        emulate("labjack_t7", rigs=rigs)


def test_second_port_in_use_leaves_nothing_open(served):
    port = int(served("labjack_t7").split(":")[1])
    with pytest.raises(InputError, match=f"listen on 127.0.0.1:{port}"):
        served("adam_6224", reader="adam_6217", reader_port=port)


def test_log_that_can_not_be_written_is_refused(served, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        served("labjack_t7", log=tmp_path / "none" / "log.jsonl")

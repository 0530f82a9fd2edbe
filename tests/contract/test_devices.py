"""The device contract, tested for every shipped device.

Simulated devices are tested directly. Devices with a transport are tested with an emulator on
loopback, one per shipped profile, together with a second profile if one cannot drive and measure.
The emulator's time advances with the exchanges, so results do not depend on the machine's speed.
"""

from contextlib import ExitStack
from importlib import import_module
from pathlib import Path

import pytest

from hilctl.experiment.devices import BUILTIN, device_class, known_devices
from hilctl_drivers.contract import *  # noqa: F403  the checks, and the fixture driven
from hilctl_drivers.contract import RATE_HZ, SAMPLES, DrivenDevice, driven_device
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.profile import load_profile, shipped_profiles
from hilctl_drivers.simulated.devices import PiezoOptions, TerfenolOptions
from tests.fakes import ManualClock, emulated, one_rig

SETTLED_NS = 2_000_000
"""What the emulated rig takes to settle, 0.1 ms, many times over: it computes each sample of it."""
TIMEOUT_S = 5.0
"""A busy machine answers within it."""
ELSEWHERE = {"serial_dac": "test_serial_devices.py", "modbus_stream": "test_modbus_stream.py"}
"""Devices that are tested with this contract in another file."""
SIMULATED = sorted(set(BUILTIN) - {"modbus_dac", *ELSEWHERE})
MODBUS = (
    "adam_6024", "beckhoff_bk9000", "generic_float32", "icp_et7000", "labjack_t4", "labjack_t7",
    "labjack_t8", "wago_750", "rtu",
    # Output profile, input profile, and whether they share a connection.
    "adam_4024 adam_4117 same", "adam_4024 adam_4117 own", "adam_6224 adam_6217 same",
    "adam_6224 adam_6217 own", "icp_m7024 icp_m7017 same", "waveshare_ao_8ch waveshare_ai_8ch same",
    "waveshare_ao_8ch_b waveshare_ai_8ch_b same", "adam_4024 adam_6217 own",
    "adam_6224 agilent_34970a own", "icp_m7024 labjack_t7 own",
    "adam_6224 moxa_iologik_e1240 own", "adam_6224 acromag_962en own",
)  # fmt: skip
"""What modbus_dac is tried with; every shipped Modbus profile is among them."""
PIEZO = ("generic_float32 V", "labjack_t8 V")
"""Modbus profiles that drive a piezo too: with both signs, and from 0 V."""


def simulated(kind):
    chosen = device_class(kind)
    device = chosen(chosen.Options())
    return DrivenDevice(
        device, SAMPLES, RATE_HZ, lambda: device.last_command, name=kind, starts_at_rest=True
    )


def of_another_package(kind):
    """Return an installed third-party simulated device, or the example device."""
    chosen = EXAMPLES[kind]() if kind in EXAMPLES else device_class(kind)
    device = chosen(chosen.Options())
    if not device.info.simulated:
        pytest.skip(f"{kind} drives hardware: pytest --device EXPERIMENT tests/hardware")
    driven = driven_device(device)
    driven.name = kind
    return driven


def _spring():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[1] / "data" / "own_device")
        return import_module("own_device.spring").Spring


EXAMPLES = {"spring": _spring}
OTHERS = sorted({*EXAMPLES, *known_devices()} - set(BUILTIN))


MODULE = str(Path(__file__).parents[1] / "data" / "milliampere_module.yaml")
"""A device with an input on a serial line, which no shipped profile is."""


def modbus(words, stack):
    """Return a modbus_dac connected to an emulator of one or two profiles."""
    clock = ManualClock()
    actuator = PiezoOptions() if words[-1] == "V" else TerfenolOptions()
    name, reader, line = [*(word for word in words if word != "V"), None, None][:3]
    wanted = EmulatorOptions(
        name, reader=reader, reader_line=line, rigs=one_rig(actuator=actuator), command=0.0
    )
    emulator = stack.enter_context(emulated(wanted, clock))
    chosen = device_class("modbus_dac")
    options = _fast({**emulator.options, "timeout_s": TIMEOUT_S})
    if "reader" in options:
        options["reader"] = _fast(options["reader"])
    device = chosen(chosen.Options.model_validate(options))
    rate_hz = min(RATE_HZ, device.info.max_rate_hz)

    def pass_time():
        clock.now_ns += min(round(1e9 / rate_hz), SETTLED_NS)

    return DrivenDevice(
        device, 1, rate_hz, lambda: emulator.rigs[0].rig.command, pass_time, name="modbus_dac"
    )


def _fast(section):
    return {**section, "baud": 115200} if "serial_port" in section else section


CASES = [
    *SIMULATED,
    *OTHERS,
    *(f"modbus_dac {words}" for words in (*MODBUS, *PIEZO)),
]


@pytest.fixture
def make():
    """Return a factory of devices, which are closed afterwards."""
    with ExitStack() as stack:

        def of(case):
            kind, *words = case.split()
            if words == ["rtu"]:
                words = [MODULE]
            if kind == "modbus_dac":
                driven = modbus(words, stack)
            elif kind in OTHERS:
                driven = of_another_package(kind)
            else:
                driven = simulated(kind)
            stack.callback(driven.device.close)
            return driven

        yield of


@pytest.fixture(params=CASES)
def case(request):
    """A device by its registry name, with a profile if it needs one."""
    return request.param


def test_no_device_is_left_out():
    assert {case.split()[0] for case in CASES} | set(ELSEWHERE) == {*BUILTIN, *OTHERS}
    folder = Path(__file__).parent
    assert [name for name in ELSEWHERE.values() if not (folder / name).exists()] == []


def test_no_modbus_profile_is_left_out():
    shipped = {name: load_profile(name) for name in shipped_profiles()}
    kept = {name: each for name, each in shipped.items() if isinstance(each, ModbusProfile)}
    pairs = [words.split()[:2] for words in MODBUS if words != "rtu"]
    assert {name for pair in pairs for name in pair} & set(shipped) - {"agilent_34970a"} == set(
        kept
    )
    assert all(shipped[pair[0]].outputs and shipped[pair[-1]].inputs for pair in pairs)
    only_read = {name for name, each in kept.items() if not each.outputs}
    assert only_read <= {pair[1] for pair in pairs if len(pair) == 2}

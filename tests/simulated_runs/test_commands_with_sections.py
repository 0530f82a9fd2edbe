"""Every command that moves a rig with every section of an experiment: success, or the key.

The table is complete in the sections. Each cell states how the command ends.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import yaml

from hilctl import api
from hilctl.base.errors import HilctlError
from hilctl.experiment.file import Experiment
from hilctl.experiment.sections.limits import Limits
from tests import commands
from tests.commands import Ended, in_process
from tests.unit.base.test_calibration import AMPLIFIER, CALIBRATION

RIG = {
    "name": "rig",
    "device": {"kind": "simulated_terfenol", "seed": 3},
    "sample_rate_hz": 2000,
    "block": 20,
    "limits": {"peak_current_a": 6.0, "slew_a_per_s": 5000.0, "stroke_um": [-48.0, 50.0]},
    "safe": {"ramp_s": 0.05},
}
TIMES = {"frequency_hz": 20.0, "duration_s": 0.5, "soft_start_s": 0.1, "soft_end_s": 0.05}
DRIVEN = {
    **RIG,
    "waveform": {"kind": "sine", "unit": "A", "amplitude": 2.0, **TIMES},
    "compensator": "none",
}
COMPENSATED = {
    **RIG,
    "waveform": {"kind": "sine", "unit": "um", "amplitude": 8.0, **TIMES},
    "compensator": {"model": "model.yaml"},
}
MODEL = {
    "kind": "rdpi", "direct": 6.5, "weights": [2.3, 0.4], "thresholds": [0.3, 0.6],
    "output_range_um": [-40.0, 40.0],
}  # fmt: skip
TONES = "waveform={kind: multisine, unit: um, amplitude: 6.0, first_hz: 10.0, last_hz: 400.0, "
TONES += "step_hz: 10.0, duration_s: 1.0}"
BAND = "first_hz: 10.0, last_hz: 100.0"
INTEGRAL = "feedback={kind: integral, limit_um: 5.0, bandwidth_hz: 2.0}"
PI = "feedback={limit_um: 5.0, ki_per_s: 20.0, %s}"
WARM = "device.temperatures={coil_tau_s: 0.2}"
TIMING = "{late_after: 0.9, max_late_s: 2.0, max_missed_share: 0.5}"
RECORDING = "{folder: elsewhere, flush_s: 0.1, sync: true, scope_rate_hz: 100.0, ring_s: 1.0, "
RECORDING += "on_failure: go_on}"

MOVING = ("run", "check", "sweep", "campaign")
"""Commands whose motion is that of the experiment."""
OF_A_MODEL = (*MOVING, "learn", "compare")
RIG_ONLY = ("calibrate", "characterise")
"""Commands with waveforms of their own and no compensator."""
DEVICE_ONLY = ("safe", "probe")


def ends(code, words, *names):
    """Return the cells of commands that end with a code and these words."""
    return dict.fromkeys(names, (code, words))


def faults(words, *names):
    """Return the cells of a run that ends by a fault; ``check`` passes."""
    return ends(3, words, "run", "campaign", *names)


class Row(NamedTuple):
    """Settings over an experiment, and the cells where a command does not succeed."""

    base: dict
    settings: tuple
    cells: dict


NO_MODEL = {**ends(2, "compensator", "learn"), **ends(2, "waveform", "compare")}


def driven(*settings, **cells):
    return Row(DRIVEN, settings, {**NO_MODEL, **cells})


def compensated(*settings, **cells):
    return Row(COMPENSATED, settings, cells)


ROWS = {
    "no section": compensated(),
    "no compensator": driven(),
    "initial state at rest": compensated("compensator.initial_state=rest"),
    "initial state after a run": compensated("compensator.initial_state=base.mcap"),
    "measured offset": compensated("compensator.offset=measured"),
    "correction": compensated("compensator.correction=correction.yaml"),
    "condition": compensated("condition={cycles: 3, frequency_hz: 20.0, rest_s: 0.0123}"),
    "condition without a model": driven("condition={cycles: 3, frequency_hz: 20.0}"),
    "zero": compensated("zero=true"),
    "zero without a model": driven("zero=true"),
    "PI feedback": compensated("block=1", PI % "resonance_hz: 900.0, damping_ratio: 0.1"),
    "measured response": compensated("block=1", PI % "response: response.yaml"),
    "integral feedback": compensated(INTEGRAL),
    "feedback without a model": driven(
        INTEGRAL, **ends(2, "feedback", *MOVING, "learn"),
    ),
    "adaptation": compensated("adaptation={time_constant_s: 1.0, noise_um: 0.05}"),
    "adaptation and feedback": compensated(
        "compensator.offset=measured", "adaptation={time_constant_s: 1.0}", INTEGRAL
    ),
    "adaptation without a model": driven(
        "adaptation={noise_um: 0.05}", **ends(2, "adaptation", *MOVING, "learn"),
    ),
    "marks": driven("block=1", "trigger={output: cycle}"),
    "on target": compensated(
        "block=1", "on_target={tolerance_um: 0.5, settle_s: 0.001}", "trigger={output: on_target}"
    ),
    "start by an input": compensated("block=1", "trigger={start: high, timeout_s: 30.0}"),
    "marks of blocks": compensated(
        "trigger={output: run}", **ends(2, "block", *MOVING, "learn"),
    ),
    "calibrated sensor": compensated("device.calibration=sensor.yaml"),
    "calibrated sensor without a model": driven("device.calibration=sensor.yaml"),
    "calibrated amplifier": compensated(
        "device.calibration=amplifier.yaml",
        **ends(2, "calibration", *OF_A_MODEL, *RIG_ONLY, *DEVICE_ONLY),
    ),
    "auxiliary channels": compensated(WARM, "limits.aux={coil_c: [0, 80], rod_c: 90}"),
    "auxiliary channels without a model": driven(WARM, "limits.aux={coil_c: 80}"),
    "auxiliary channel beyond its limit": compensated(
        WARM, "limits.aux={coil_c: 10}", **faults("coil_c", "learn", "calibrate"),
    ),
    "unknown auxiliary channel": compensated(
        "limits.aux={coil_c: 80}", **ends(2, "limits.aux.coil_c", *MOVING, "learn", *RIG_ONLY),
    ),
    "amplifier": driven("amplifier={voltage_max_v: 99, resistance_ohm: 2, inductance_h: 0.003}"),
    "small amplifier": driven(
        "amplifier={voltage_max_v: 1.0, resistance_ohm: 2.0, inductance_h: 0.003}",
        **ends(2, "amplifier.voltage_max_v", *MOVING, "learn", "calibrate"),
    ),
    "thermal budget": compensated(
        "limits.rms_current_a=3.0", "limits.thermal_time_constant_s=5.0"
    ),
    "small thermal budget": driven(
        "limits.rms_current_a=0.2", "limits.thermal_time_constant_s=0.3",
        **ends(2, "limits.rms_current_a", *MOVING, "learn", "calibrate"),
    ),
    "tracking error": compensated("limits.tracking_error_um=20.0", "limits.tracking_s=0.01"),
    "no tracking error": compensated("limits.tracking_error_um=null"),
    "small tracking error": compensated(
        "limits.tracking_error_um=0.01", "limits.tracking_s=0.01",
        **faults("tracking error", "learn"),
    ),
    "tracking error without a model": driven(
        "limits.tracking_error_um=20.0", "limits.tracking_s=0.01",
        **ends(2, "limits.tracking_error_um", *MOVING, "learn"),
    ),
    "frozen sensor": driven("limits.frozen_s=0.5", "limits.frozen_um=0.01"),
    "measured deviation": driven("limits.measured_deviation_a=1.0", "limits.deviation_s=0.05"),
    "deviation in V": driven(
        "limits.measured_deviation_v=1.0", "limits.deviation_s=0.05",
        **ends(2, "limits.measured_deviation_v", *MOVING, "learn", *RIG_ONLY),
    ),
    "invalid readings": driven("limits.sensor_invalid_s=0.1"),
    "drive of two ends": driven(
        "limits={drive_a: [-5.0, 6.0], slew_a_per_s: 5000.0, stroke_um: [-48.0, 50.0]}"
    ),
    "drive in V": driven(
        "limits={drive_v: [-5.0, 6.0], slew_v_per_s: 5000.0, stroke_um: [-48.0, 50.0]}",
        **ends(2, "limits", *MOVING, "learn", *RIG_ONLY),
        **ends(2, "waveform", "probe"),
    ),
    "small stroke": driven(
        "limits.stroke_um=[-1.0, 1.0]", **faults("stroke", "calibrate"),
    ),
    "safe value": compensated("safe.value=1.0"),
    "safe value without a model": driven("safe.value=1.0"),
    "output before the run": compensated("device.output_at_open=2.0"),
    "stated output before the run": driven("safe.at_start=1.0"),
    "timing": compensated(f"timing={TIMING}"),
    "recording": driven(f"recording={RECORDING}"),
    "realtime": driven("realtime={priority: 30, cpu: 0, require: false}"),
    "labels": driven("labels={operator: N. N., sample: 4}"),
    "physics": driven(
        "device={kind: simulated_terfenol, load_kg: 0.5, vary: {lag: 1.1}, "
        "drift: {um: 2.0, tau_s: 0.3}, creep: {share: 0.02, time_constants_s: [0.1]}}"
    ),
    "missing reading": driven(
        "device.fault={kind: sensor_nan, at_sample: 100}", **faults("sample 100", "calibrate"),
    ),
    "lost device": driven(
        "device.fault={kind: no_answer, at_sample: 100}", **faults("no answer", "calibrate"),
    ),
    "random": driven(f"waveform={{kind: random, unit: A, amplitude: 0.5, {BAND}, duration_s: 1}}"),
    "file": driven("waveform={kind: file, unit: A, path: wave.csv, file_rate_hz: 2000}"),
    "sequence": driven(
        "waveform={kind: sequence, unit: A, parts: [{kind: hold, level: 0.0, duration_s: 0.1}, "
        "{kind: step, levels: [0.0, 1.0], dwell_s: 0.1}]}"
    ),
}  # fmt: skip
SHOWN = ("calibrated sensor", "adaptation and feedback", "auxiliary channels")
"""Rows that also run in real time, or are characterised, in the shorter suite."""
CHARACTERISED = ("calibrated sensor", "auxiliary channels", "output before the run")


def test_every_section_is_in_the_table():
    given = {setting.partition("=")[0] for row in ROWS.values() for setting in row.settings}
    whole = {key.partition(".")[0] for key in given} | DRIVEN.keys() | {"description"}  # varied
    assert {*Experiment.model_fields} - {"apart", "coupling"} <= whole  # these need axes
    limits = {*DRIVEN["limits"]}
    for row in ROWS.values():
        for key, _, value in (setting.partition("=") for setting in row.settings):
            limits |= {key.partition(".")[2]} if key.startswith("limits.") else set()
            limits |= {*yaml.safe_load(value)} if key == "limits" else set()
    assert {*Limits.model_fields} <= limits


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with both experiments and all files that the rows name."""
    folder = tmp_path_factory.mktemp("sections")
    for name, content in (
        ("driven", DRIVEN), ("compensated", COMPENSATED), ("model", {"model": MODEL}),
        ("campaign", {"name": "few", "experiment": "x.yaml", "repeat": 1}),
    ):  # fmt: skip
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    (folder / "sensor.yaml").write_text(CALIBRATION, encoding="utf-8")
    (folder / "amplifier.yaml").write_text(AMPLIFIER, encoding="utf-8")
    np.savetxt(folder / "wave.csv", np.sin(np.arange(1000) * 2.0 * np.pi / 100))
    base = folder / "compensated.yaml"
    api.run(base, folder / "base.mcap", fast=True)
    api.run(base, folder / "tones.mcap", settings=[TONES], fast=True)
    api.run(folder / "driven.yaml", folder / "loops.mcap", fast=True)
    api.tune(folder / "tones.mcap", folder / "response.yaml")
    api.learn(base, folder / "correction.yaml", cycles=1, fast=True)
    return folder


@pytest.fixture
def hilctl(monkeypatch, capsys, place):
    monkeypatch.chdir(place)
    return in_process(monkeypatch, capsys)


def experiment_of(row):
    return "driven.yaml" if row.base is DRIVEN else "compensated.yaml"


def run_without_real_time(row, output):
    """Run a row and evaluate its recording; return how it ended."""
    try:
        run = api.run(experiment_of(row), output, settings=list(row.settings), fast=True)
    except HilctlError as error:
        return Ended(error.exit_code, "", str(error))
    api.summarize(run.path)
    assert api.replay(run.path).identical
    return Ended(0 if run.code == "completed" else 3, "", run.reason)


@pytest.mark.parametrize("name", ROWS)
def test_commands_with_a_section(hilctl, name, tmp_path, place):
    row = ROWS[name]
    file, settings = experiment_of(row), [f"--set={each}" for each in row.settings]
    campaign = tmp_path / "campaign.yaml"
    content = {"name": "few", "experiment": str(place / file), "vary": {"description": ["a"]}}
    campaign.write_text(yaml.safe_dump(content), encoding="utf-8")
    by = ("--output", tmp_path / "calibration.yaml", "--by", "N. N.", "--fast")
    words = {
        "check": ("check", file),
        # In real time: the plan alone.
        "sweep": ("sweep", file, "--vary=description=a,b", "--dry-run", "--folder", tmp_path / "s"),
        "campaign": ("campaign", campaign, "--fast", "--folder", tmp_path / "campaign"),
        "learn": ("learn", file, "--output", tmp_path / "c.yaml", "--fast", "--cycles", 1),
        "compare": ("compare", "loops.mcap", "--models", "ppi", "--experiment", file),
        "calibrate": ("calibrate", "amplifier", file, *by),
        "characterise": ("characterise", file, "--output", tmp_path / "m.yaml", "--dry-run"),
        "safe": ("safe", file),
        "probe": ("devices", "probe", file),
    }
    found = {"run": run_without_real_time(row, tmp_path / "run.mcap")}
    found |= {command: hilctl(*each, *settings) for command, each in words.items()}
    expected = {command: row.cells.get(command, (0, "")) for command in found}
    assert {command: each.code for command, each in found.items()} == {
        command: code for command, (code, _) in expected.items()
    }, {command: each.err for command, each in found.items()}
    for command, (_, said) in expected.items():
        assert said in found[command].out + found[command].err, command


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=() if name in SHOWN else pytest.mark.long) for name in ROWS
])  # fmt: skip
def test_section_in_real_time(place, name, tmp_path):
    row = ROWS[name]
    words = ("run", experiment_of(row), "--output", tmp_path / "run.mcap", "--json")
    settings = [f"--set={each}" for each in row.settings]
    code, said = row.cells.get("run", (0, ""))
    ended = commands.hilctl(*words, *settings, code=code, cwd=place)
    assert said in ended.stdout


@pytest.mark.long
@pytest.mark.parametrize("name", CHARACTERISED)
def test_section_is_characterised(hilctl, name, tmp_path):
    row = ROWS[name]
    settings = [f"--set={each}" for each in row.settings]
    output = tmp_path / "model.yaml"
    ended = hilctl("characterise", experiment_of(row), "--output", output, "--fast", *settings)
    assert ended.code == 0, ended.err
    assert Path(output).is_file()

"""What a message advises: where a limit is exceeded, and a change that passes the check."""

import re
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from hilctl.experiment.coil_heat import RunHeat
from hilctl.experiment.sections.cures import Course, cured
from hilctl.experiment.sections.limits import command_excess
from hilctl.models.plays import PpiModel
from tests.published import terfenol_rdpi
from tests.unit.experiment.test_preflight import (
    CURRENT,
    DISPLACEMENT,
    VOLTAGE,
    checked,
    loaded,
    refusals,
)

VOLTS = (
    CURRENT.replace("unit: A", "unit: V")
    .replace("peak_current_a: 7.0", "drive_v: [0.0, 6.0]")
    .replace("slew_a_per_s", "slew_v_per_s")
)
HEAT = ["limits.rms_current_a=3.5", "limits.thermal_time_constant_s=0.6"]
ADVISED = re.compile(r"(?:set|raise) (\S+) to (\[.*?\]|[-\d.e+]+)")


@pytest.mark.parametrize(
    ("text", "settings", "given", "advised", "others"),
    [
        (CURRENT, ["limits.peak_current_a=6.1234567"], {}, "raise limits.peak_current_a to 6.5",
         [["waveform.amplitude=5.6"], ["waveform.offset=0.1"]]),
        (CURRENT, ["limits.peak_current_a=6.0", "waveform.amplitude=7.9"],
         {}, "fake, -8 to 8 A", [["waveform.amplitude=5.5"]]),
        (CURRENT, ["waveform.offset=9.0", "limits.slew_a_per_s=1e6"], {}, "fake, -8 to 8 A",
         [["waveform.offset=1.0"]]),
        (CURRENT, ["waveform.offset=9.0", "waveform.amplitude=8.0", "limits.slew_a_per_s=1e6"],
         {}, "fake, -8 to 8 A", [["waveform.offset=1.0", "waveform.amplitude=6.0"]]),
        (CURRENT, ["limits.peak_current_a=9.0"], {}, "set limits.peak_current_a to 8.0", []),
        (CURRENT, ["waveform.offset=3.5", "waveform.amplitude=3.0", "limits.slew_a_per_s=1e6"],
         {"command_min": 0.0, "command_max": 20.0}, "limits.drive_a to [0.0, 7.0]", []),
        (VOLTS, [], {"command_unit": "V"}, "raise limits.drive_v to [-5.5, 6.5]",
         [["waveform.offset=0.0", "limits.drive_v=[-6.0, 6.0]"]]),
        (CURRENT, ["limits.slew_a_per_s=123.4567"], {}, "raise limits.slew_a_per_s to 5000",
         [["waveform.soft_start_s=0.5", "waveform.frequency_hz=2.0"]]),
        (CURRENT, HEAT, {}, "end it within 0.63",
         [["waveform.duration_s=0.6333"], ["waveform.amplitude=4.0"]]),
        (CURRENT, [*HEAT, "waveform.amplitude=1.0", "condition={decay: 1.0, cycles: 50}"], {},
         "condition's amplitude", [["condition.amplitude_a=3.0"], ["condition.cycles=3"]]),
        (CURRENT, [*HEAT, "limits.slew_a_per_s=1e6", "safe.value=3.6"], {}, "lower safe.value",
         [["safe.value=0.0", "waveform.amplitude=4.0"]]),
        (DISPLACEMENT, ["limits.stroke_um=[-5.0, 60.0]"], {}, "amplitude or offset",
         [["waveform.amplitude=4.5"], ["waveform.offset=6.0"]]),
        (DISPLACEMENT, ["limits.stroke_um=[-9.0, 9.0]"], {}, "lower the waveform's amplitude",
         [["waveform.amplitude=8.5"]]),
        (DISPLACEMENT, ["limits.slew_a_per_s=1000.0", "waveform.soft_start_s=0"],
         {"offset_um": 20.0}, "set waveform.soft_start_s to", []),
        (CURRENT, [VOLTAGE, "waveform.soft_start_s=0.3"], {}, "set waveform.amplitude to",
         [["waveform.frequency_hz=5.0"], ["amplifier.voltage_max_v=10.2"]]),
        (CURRENT, [VOLTAGE], {}, "soft_start_s",
         [["waveform.soft_start_s=0.3", "waveform.amplitude=4.0"]]),
        (CURRENT, [VOLTAGE, "amplifier.resistance_ohm=4.0", "waveform.soft_start_s=0.3"], {},
         "2 A", [["waveform.amplitude=0.5"]]),
        (CURRENT, [VOLTAGE, "waveform.amplitude=1.0", "waveform.soft_start_s=0.3",
                   "condition={amplitude_a: 6.0}"], {},
         "condition's", [["condition.frequency_hz=3.0"], ["condition.amplitude_a=3.0"]]),
    ],
)  # fmt: skip
def test_what_a_message_advises_passes_the_check(text, settings, given, advised, others):
    offset_um = given.pop("offset_um", 0.0)
    model = terfenol_rdpi().model_copy(update={"output_offset_um": offset_um})
    given = given | ({"model": model} if text is DISPLACEMENT else {})
    (found,) = refusals(text, *settings, **given)
    assert advised in found.hint
    cures = [[f"{key}={value}"] for key, value in ADVISED.findall(found.hint)] + others
    for cure in cures:
        instead = ["limits.peak_current_a=null"] if "limits.drive_a" in cure[0] else []
        checked(text, *settings, *cure, *instead, **given)


def test_a_unipolar_drive_reaches_the_offset_before_its_loops():
    """Small loops of the soft start need commands below 0, which those about the offset do not."""
    settings = [
        "limits={drive_a: [0.0, 30.0], slew_a_per_s: 20000.0, stroke_um: [-75.0, 60.0]}",
        "waveform.amplitude=8.0", "waveform.offset=10.0", "waveform.soft_start_s=0.5",
    ]  # fmt: skip
    model = PpiModel(direct=0.5, weights=(1.0,), thresholds=(1.0,))
    given = {"model": model, "command_min": 0.0, "command_max": 30.0}
    (found,) = refusals(DISPLACEMENT, *settings, **given)
    assert "hold" in found.hint
    assert not ADVISED.findall(found.hint)
    checked(DISPLACEMENT, *settings, "waveform.amplitude=6.0", **given)
    hold = "{kind: hold, level: 10.0, duration_s: 0.5, soft_start_s: 0.3}"
    sine = "{kind: sine, amplitude: 8.0, offset: 10.0, frequency_hz: 10.0, duration_s: 1.0}"
    held = f"waveform={{kind: sequence, unit: A, parts: [{hold}, {sine}]}}"
    checked(DISPLACEMENT, settings[0], held, **given)


def test_a_file_that_is_too_large_is_cured_by_its_scale(tmp_path):
    path = tmp_path / "reference.csv"
    path.write_text(
        "reference\n" + "\n".join(f"{10.0 * np.sin(2e-3 * np.pi * k):.6f}" for k in range(1000))
    )
    waveform = f"waveform={{kind: file, path: {path}, unit: A, file_rate_hz: 10000.0}}"
    settings, model = (waveform, "limits.stroke_um=[-9.0, 9.0]"), terfenol_rdpi()
    (found,) = refusals(DISPLACEMENT, *settings, model=model)
    assert "scale" in found.hint
    checked(DISPLACEMENT, *settings, "waveform.scale=0.85", model=model)


class TestBudget:
    BUDGET: ClassVar = ("limits.rms_current_a=4.0", "limits.thermal_time_constant_s=20.0")

    def hint(self, begins_rms_a, hottest_a2, safe=0.0):
        made = loaded(CURRENT, *self.BUDGET, f"safe.value={safe}")
        forecast = replace(
            checked(CURRENT).forecast, heating_rms_a=4.5, budget_used_s=1.5, before_s=1.5,
            begins_rms_a=begins_rms_a, heat=RunHeat(2.0, 1.0, hottest_a2),
        )  # fmt: skip
        reference = checked(CURRENT).reference
        course = Course(made.config.waveform, reference, forecast, made.config.limits, made.rig)
        (problem,) = cured(command_excess(course.limits, course.rig, forecast), course)
        assert problem.key == "limits.rms_current_a"
        assert problem.value == "4.5 A"
        return problem.hint

    @pytest.mark.parametrize(
        ("begins_rms_a", "hottest_a2", "safe", "wait_s"),
        [(3.0, 4.0, 0.0, 16), (2.02, 4.0, 0.0, 0), (3.5, 10.0, 3.0, 24)],
    )
    def test_heat_of_the_last_run_is_waited_for(self, begins_rms_a, hottest_a2, safe, wait_s):
        """20 s times ln(9 / 4), ln(4.08 / 4), and ln(3.25 / 1) above what the safe value makes."""
        hint = self.hint(begins_rms_a, hottest_a2, safe)
        assert f"{begins_rms_a:.3g} A" in hint
        assert hint.endswith(f"wait {wait_s} s")

    @pytest.mark.parametrize(
        ("begins_rms_a", "hottest_a2", "safe"),
        [(1.0, 4.0, 0.0), (3.0, 4.0, 2.0), (3.5, 8.0, 3.0), (None, 0.5, 0.0)],
    )
    def test_no_wait_helps_a_run_that_makes_the_heat_itself(self, begins_rms_a, hottest_a2, safe):
        hint = self.hint(begins_rms_a, hottest_a2, safe)
        assert hint.startswith("0.5 A")

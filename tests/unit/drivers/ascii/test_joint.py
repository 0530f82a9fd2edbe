"""Several axes of a GCS controller, which one message reads and sets."""

import numpy as np
import pytest

from hilctl.base.device import joined
from hilctl.base.errors import DeviceError
from hilctl_drivers.dac import SerialDac, SerialOptions
from hilctl_drivers.profile import shipped_profiles
from hilctl_drivers.transport.links import NoAnswerError


class Controller:
    """A link to a GCS controller of three axes, whose positions are a tenth of the voltages.

    It answers by the rules of the GCS manual: an argument per axis, a line per answer, a blank and
    a line feed at the end of all lines but the last.
    """

    def __init__(self):
        self.volts = {"1": 10.0, "2": 20.0, "3": 30.0}
        self.requests, self.is_open, self.sets = [], False, []

    def open(self, *, boot=True):
        self.is_open = True

    def transact(self, request, missing, usual=0):
        self.requests.append(bytes(request).decode())
        reply = "".join(map(self.answer, bytes(request).decode().splitlines())).encode()
        if missing(bytearray(reply)) or (not reply and missing(bytearray())):
            raise NoAnswerError("no answer within 1 s")
        return reply

    def answer(self, line):
        verb, *words = line.split()
        answers = {
            "*IDN?": lambda: "Physik Instrumente, E-727.3CD, 0, 0",
            "ERR?": lambda: "0",
            "POS?": lambda: " \n".join(f"{axis}={0.1 * self.volts[axis]:.4f}" for axis in words),
            "SVA?": lambda: " \n".join(f"{axis}={self.volts[axis]:.4f}" for axis in words),
            "SVO?": lambda: " \n".join(f"{axis}=0" for axis in words),
        }
        if verb in answers:
            return answers[verb]() + "\n"
        assert verb in {"SVA", "SVO"}
        if verb == "SVA":
            found = dict(zip(words[::2], map(float, words[1::2]), strict=True))
            self.sets.append(found)
            self.volts |= found
        return ""

    def doubt(self):
        self.is_open = False

    close = doubt


def devices(link, profile="pi_e727_3cd"):
    found = {}
    for axis, number in (("x", 1), ("y", 2)):
        options = {
            "profile": profile, "host": "h", "output": f"axis{number}",
            "input": f"position{number}", "amplifier": {"gain_v_per_v": 1.0},
            "watchdog": "none", "timeout_s": 1.0,
        }  # fmt: skip
        found[axis] = SerialDac(SerialOptions.model_validate(options), link)
    return found


def exchange(joint, *values):
    found = np.full((2, 1), np.nan)
    joint.exchange(0, [np.array([each]) for each in values], [*found], [np.empty(1)] * 2)
    return found[:, 0].tolist()


def test_one_message_reads_both_positions_and_sets_both_voltages():
    link = Controller()
    made = devices(link)
    joint = joined(made)["x", "y"]
    joint.open(20.0, 1)
    assert {each.info.details["transactions"] for each in made.values()} == {"1"}
    assert [each.output() for each in made.values()] == [10.0, 20.0]
    link.requests.clear()
    link.sets.clear()
    assert exchange(joint, 30.0, 40.5) == [1.0, 2.0]
    assert exchange(joint, 31.0, 41.5) == pytest.approx([3.0, 4.05])
    assert link.requests[0] == "POS? 1 2\nSVA 1 30.0000 2 40.5000\n"
    assert link.sets == [{"1": 30.0, "2": 40.5}, {"1": 31.0, "2": 41.5}]
    assert len(link.requests) == 2
    joint.close()


def test_a_joint_message_has_the_effect_of_one_per_axis():
    together, apart = Controller(), Controller()
    joint = joined(devices(together))["x", "y"]
    joint.open(20.0, 1)
    found = [exchange(joint, *values) for values in ((30.0, 40.5), (0.1234, 99.9999))]
    joint.close()
    shown = []
    for k, device in enumerate(devices(apart).values()):
        device.open(20.0, 1)
        for values in ((30.0, 40.5), (0.1234, 99.9999)):
            displacement_um = np.empty(1)
            device.exchange(0, np.array([values[k]]), displacement_um, np.empty(1))
            shown.append(displacement_um.item())
        device.close()
    assert together.volts == apart.volts
    assert [each[k] for k in (0, 1) for each in found] == shown


def test_an_answer_of_another_axis_is_no_answer():
    link = Controller()
    made = devices(link)
    joint = joined(made)["x", "y"]
    joint.open(20.0, 1)
    link.answer = lambda line: "2=1.0000 \n1=2.0000\n" if line.startswith("POS") else ""
    with pytest.raises(DeviceError, match="does not match"):
        exchange(joint, 1.0, 2.0)
    for device in made.values():
        with pytest.raises(DeviceError, match="not open"):
            device.output()


def test_without_joint_lines_each_axis_is_on_its_own(tmp_path):
    text = shipped_profiles()["pi_e727_3cd"].read_text(encoding="utf-8")
    plain = tmp_path / "plain.yaml"
    text = text.replace('joint: {ask: "POS?", write: "SVA"}\n', "").replace("joint, ", "")
    plain.write_text(text, encoding="utf-8")
    assert [*joined(devices(Controller(), str(plain)))] == [("x",), ("y",)]


def test_each_axis_is_made_safe():
    link = Controller()
    made = devices(link)
    joint = joined(made)["x", "y"]
    joint.open(20.0, 1)
    exchange(joint, 30.0, 40.0)
    for device in made.values():
        device.make_safe(5.0)
    assert link.volts == {"1": 5.0, "2": 5.0, "3": 30.0}
    joint.close()

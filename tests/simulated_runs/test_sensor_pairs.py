"""Output and sensor on devices of different protocols, over every kind of link, sample by sample.

The emulator's time stands still during an exchange, so each reading is known. A sensor that sends
unasked needs time that passes; there the age tells which block was read.
"""

import time
from bisect import bisect_right
from pathlib import Path

import numpy as np
import pytest

from hilctl.experiment.devices import device_class
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.profile import load_profile, shipped_profiles
from hilctl_drivers.simulated.devices import TerfenolOptions
from hilctl_drivers.transport.serial_port import SerialLink
from tests.fakes import ManualClock, ShiftedClock, emulated, logged, one_rig

SAMPLES = 2000
STILL = TerfenolOptions(noise=False)
PATIENT_S = 10.0
RTU = {"adam_4024", "adam_4117", "icp_m7017", "icp_m7024"}
LSB_UM = 0.03  # of the coarsest input, 14 bits over 250 um
GCS = """\
vendor: nobody
model: a piezo controller with GCS over TCP
source: [this test]
verified: "yes"
link: {kind: ascii_tcp, port: 50000, terminator: "\\n", reply_terminator: "\\n"}
address: none
outputs:
  axis1:
    {write: "SVA 1 {value:.6f}", reply: none, unit: V, min: -10.0, max: 10.0,
      readback: {ask: "SVA? 1", pattern: "1=(-?[0-9.]+)", example: "1=10.000000"}}
inputs:
  position1:
    {ask: "POS? 1", pattern: "1=(-?[0-9.]+)", example: "1=12.3456", unit: um, min: -125,
      max: 125}
exchange: none
error_query: {ask: "ERR?", pattern: "0", example: "0"}
turnaround_s: 0.0
max_rate_hz: 1000.0
watchdog: none
"""
FRAMES = """\
vendor: nobody
model: a piezo controller with frames of fixed bytes
source: [this test]
verified: "yes"
link: {kind: bytes, baud: 115200, flow: rts_cts, checksum: sum8}
address: none
outputs:
  axis1:
    {write: "A2 {value:int32} 55", reply: none, scale: 1.0e-6, unit: V, min: -10.0, max: 10.0,
      readback: {ask: "A0 01", pattern: "A0 01 {value:int32}", example: "A0 01 00 00 00 05"}}
inputs:
  position1:
    {ask: "A0 02", pattern: "A0 02 {value:float32 DCBA}", example: "A0 02 00 00 80 3F", unit: um,
      min: -125, max: 125}
exchange: none
turnaround_s: 0.0
max_rate_hz: 1000.0
watchdog: none
"""
HEXADECIMAL = """\
vendor: nobody
model: a board with hexadecimal numbers, an echo and a prompt
source: [this test]
verified: "yes"
link: {kind: ascii, baud: 115200, terminator: "\\r", reply_terminator: "\\r# ", echo: true}
address: none
outputs:
  DAC:
    {write: "dac {value:04X}", reply: {pattern: OK, example: OK}, scale: 3.0517578125e-4,
      offset: -10.0, unit: V, min: -10.0, max: 9.9997,
      readback: {ask: "dac", pattern: "dac={value:04X}\\nOK", example: "dac=8000\\nOK"}}
inputs:
  ADC:
    {ask: "adc", pattern: "adc={value:int16X}\\nOK", example: "adc=FFFE\\nOK", scale: 0.005,
      unit: um, min: -125, max: 125}
exchange: none
turnaround_s: 0.0
max_rate_hz: 1000.0
watchdog: none
"""
XOR_FRAMES = """\
vendor: nobody
model: a controller with exclusive or inside its frames, over TCP
source: [this test]
verified: "yes"
link:
  {kind: bytes_tcp, port: 4001, checksum: xor8, checksum_from: 2, checksum_before: 1}
address: none
outputs:
  axis1:
    {write: "AA 55 01 {value:int32} 0D", reply: {pattern: "AA 55 06 0D", example: "AA 55 06 0D"},
      scale: 1.0e-6, unit: V, min: -10.0, max: 10.0,
      readback: {ask: "AA 55 02 0D", pattern: "AA 55 02 {value:int32} 0D",
        example: "AA 55 02 00 00 00 05 0D"}}
inputs:
  position1:
    {ask: "AA 55 03 0D", pattern: "AA 55 03 {value:float32} 0D",
      example: "AA 55 03 3F 80 00 00 0D", unit: um, min: -125, max: 125}
exchange: none
turnaround_s: 0.0
max_rate_hz: 1000.0
watchdog: none
"""
COMMA = """\
vendor: nobody
model: a gauge with decimal commas, blanks behind signs, and ETX at the end of a reply
source: [this test]
verified: "yes"
link: {kind: ascii, baud: 115200, terminator: ";", reply_terminator: "\\x03"}
address: none
outputs: {}
inputs:
  gauge:
    {ask: "R", pattern: "{value:f,} UM", example: "-   1,250 UM", unit: um, min: -125, max: 125}
exchange: none
turnaround_s: 0.0
max_rate_hz: 1000.0
watchdog: none
"""
DATAGRAMS = """\
vendor: nobody
model: a sensor that sends datagrams with a binary beginning
source: [this test]
verified: "yes"
link: {kind: sensor_stream_udp, port: 4002, max_age_s: 0.02}
header: {begin: AA 55, size: 6, frame_size: 4, counter: {at: 2, type: uint32}}
outputs: {}
inputs:
  position1: {at: 0, type: float32, unit: um, min: -125, max: 125}
turnaround_s: 0.0
max_rate_hz: 1000.0
watchdog: none
"""
OWN = {
    "gcs": GCS, "frames": FRAMES, "hexadecimal": HEXADECIMAL, "xor_frames": XOR_FRAMES,
    "comma": COMMA, "datagrams": DATAGRAMS,
}  # fmt: skip
PAIRS = {
    "text with LabJack": ("kepco_bop", {"reader": "labjack_t7"}),
    "Modbus TCP with text": ("adam_6224", {"reader": "agilent_34970a"}),
    "GCS over TCP": ("gcs", {}),
    "RTU over TCP": ("adam_4024", {"reader": "adam_4117", "link": "rtu_tcp"}),
    "text over TCP with RTU over TCP": (
        "kepco_bop", {"reader": "icp_m7017", "link": "tcp", "reader_link": "rtu_tcp"},
    ),
    "board with text over TCP": ("cobs_board", {"reader": "gcs"}),
    "frames of fixed bytes": ("frames", {}),
    "hexadecimal numbers": ("hexadecimal", {}),
    "checksum inside frames": ("xor_frames", {}),
    "frames over TCP with decimal commas": ("xor_frames", {"reader": "comma"}),
    "text with frames": ("kepco_bop", {"reader": "frames"}),
    "Modbus RTU with a board": ("icp_m7024", {"reader": "cobs_board"}),
    "text with a stream": ("kepco_bop", {"reader": "capancdt_6200"}),
    "text with a stream on a serial line": ("kepco_bop", {"reader": "optoncdt_1420"}),
    "text with a stream of datagrams": ("kepco_bop", {"reader": "datagrams"}),
}  # fmt: skip


@pytest.fixture
def profile(tmp_path):
    """Return a function that returns the path of a profile, of which no board has to boot."""

    def of(name):
        text = OWN.get(name) or shipped_profiles()[name].read_text()
        path = tmp_path / f"{name}.yaml"
        text = text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0")
        path.write_text(text.replace("max_age_s: 0.02", f"max_age_s: {PATIENT_S}"))
        return str(path)

    return of


class SentBlocks:
    """Times and readings of the blocks that an emulated sensor sends unasked."""

    def __init__(self, reader):
        self.sent_ns, self.shown_um = [], []
        self._reader, self._block, self._complete = reader, reader.block, 0
        reader.block = self._keep

    def _keep(self, now_ns):
        data = self._block(now_ns)
        self.sent_ns.append(time.monotonic_ns())
        self.shown_um.append(self._reader._first.rig.displacement_um)
        return data

    def last_read_um(self, device, before_ns, read_um):
        """Return the reading of the block that an exchange since ``before_ns`` must have read.

        All blocks of before the previous exchange have arrived. On a serial line the age is an
        upper bound, so that the block is one of those since.
        """
        arrived_ns = device.reader.session._arrived_ns
        at_ns = arrived_ns + round(1e9 * device.reading_age_s)
        assert before_ns <= at_ns + 1
        assert at_ns <= time.monotonic_ns() + 1
        complete, self._complete = self._complete, bisect_right(self.sent_ns, before_ns) - 2
        if isinstance(device.reader.link, SerialLink):
            return min(self.shown_um[max(0, complete) :], key=lambda each: abs(each - read_um))
        number = bisect_right(self.sent_ns, arrived_ns) - 1
        assert number >= complete
        return self.shown_um[number]


@pytest.mark.parametrize("name", PAIRS)
def test_all_commands_and_readings_are_those_of_the_devices(profile, tmp_path, name):
    output, options = PAIRS[name]
    if "reader" in options:
        options = {**options, "reader": profile(options["reader"])}
    streams = "stream" in name
    log, clock = tmp_path / "log.jsonl", ShiftedClock() if streams else ManualClock()
    path = profile(output)
    with emulated(
        EmulatorOptions(path, log=log, rigs=one_rig(actuator=STILL), **options), clock
    ) as emulator:
        blocks = SentBlocks(emulator.reader) if streams else None
        keys = {**emulator.options, "timeout_s": PATIENT_S}
        for section in (keys, keys.get("reader")):
            placed = section and {"host", "serial_port"} & section.keys()
            if placed and Path(section["profile"]).stem in RTU:
                section["gap_s"] = 0.0  # the silence of Modbus RTU takes most of the time
        chosen = device_class(load_profile(path).DEVICE)
        device = chosen(chosen.Options.model_validate(keys))
        device.open(min(10.0, device.info.max_rate_hz), 1)
        device.arm()
        device.output()  # whatever opening sent has been executed then
        before = len(logged(log))
        sent = np.round(np.random.default_rng(1).uniform(-5.0, 5.0, SAMPLES), 3)
        displacement_um, shown_um, measured = np.zeros((3, SAMPLES))
        for k in range(SAMPLES):
            part, before_ns = slice(k, k + 1), time.monotonic_ns()
            device.exchange(k, sent[part], displacement_um[part], measured[part])
            device.output()  # a command without a reply has been executed then
            if blocks is None:
                shown_um[k] = emulator.rigs[0].rig.displacement_um
                clock.pass_s(0.001)
            else:
                shown_um[k] = blocks.last_read_um(device, before_ns, displacement_um[k])
        assert device.info.details["transactions"] == ("1" if streams else "2")
        assert device.lost_readings == 0
        device.close()
        device.make_safe(0.0)
    written = [each["current_a"] for each in logged(log)[before:] if "current_a" in each]
    assert np.abs(np.array(written[:SAMPLES]) - sent).max() < 5e-3  # a 12-bit output
    assert written[-1] == pytest.approx(0.0, abs=5e-3)
    assert np.abs(displacement_um - shown_um).max() < LSB_UM
    assert np.ptp(shown_um) > 10.0

"""Gives an emulated LabJack its stream: what it puts out moves the rig and is logged."""

import numpy as np

from hilctl.base.arrays import F64
from hilctl_drivers.emulator.emulated import EmulatedDevice
from hilctl_drivers.emulator.labjack_stream import LabJackStream
from hilctl_drivers.emulator.rig import Rig
from hilctl_drivers.emulator.write_log import WriteLog


def attach_stream(
    device: EmulatedDevice, rig: Rig, log: WriteLog, output: str, sensor: str, *, noise: bool
) -> None:
    """Give an emulated device its stream, where its profile has one for these channels.

    Args:
        device: Which.
        rig: What it stands at.
        log: Where what is put out goes.
        output: Output that drives the rig.
        sensor: Input that shows the displacement.
        noise: Whether the sensor has noise.
    """
    profile, wiring = device.profile, device.wiring
    streaming = profile.streaming
    if streaming == "none" or output not in streaming.outputs or sensor not in streaming.inputs:
        return
    channel, terminal = profile.outputs[output], profile.inputs[sensor]
    words, _ = device.memory.targets(
        channel.area, profile.wire_address(channel), [0] * channel.words
    )[0]

    def played(first: int, current_a: F64, now_ns: int) -> None:
        words.value = value = (float(current_a[-1]) - wiring.offset_a) / wiring.gain_a
        rig.put_out(float(current_a[-1]), now_ns)
        log.event(
            now_ns, "played", output=output, first=first, samples=current_a.size, value=value,
            unit=channel.unit, current_a=float(current_a[-1]),
        )  # fmt: skip

    device.overlay = LabJackStream(
        profile,
        streaming,
        output,
        sensor,
        current_a=lambda values: values * wiring.gain_a + wiring.offset_a,
        volts=lambda um: np.clip((um - wiring.offset_um) / wiring.sensor_um, *terminal.limits),
        on_played=played,
        noise=noise,
    )

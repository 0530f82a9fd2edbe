"""Simulated piezo stage: the published play-operator model and its sensor.

Source: "Modeling and Compensation of Rate-Dependent Asymmetric Hysteresis Nonlinearities of
Magnetostrictive Actuators", Concordia, chapter 3, section 4.4: stage PI P-753.31C driven over
0..100 V, thresholds (3.25) and weights (3.26). Drive voltage stands for the E-505 amplifier's
output; its gain of 10 lies before the command.
"""

import math
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64, F64_2D
from hilctl.kernels.jit import kernel
from hilctl_drivers.simulated.actuator_base import Plant

_INDEX = tuple(range(1, 11))


@dataclass(frozen=True, slots=True)
class PiezoParameters:
    """Constants of the stage, its DAC, sensor and ADC.

    Range, slope, thresholds and weights are published (chapter 3, section 4.4). The 2.632 V/um
    quoted there span the 38 um stroke over 100 V; against the 10 V of an ADC that is 0.2632 V/um,
    hence the range. The loops were identified over 10..70 V; above some 88 V the model leaves the
    sensor's range and the reading stays at its end. Bandwidth and noise are typical of such a
    sensor, not published.
    """

    drive_min_v: float = 0.0  # bottom of the drive
    drive_max_v: float = 100.0  # top of the drive
    slope_um_per_v: float = 0.2567  # weight p_0 of the drive itself
    # Play operators: r_i = sigma i and p_i = alpha exp(-beta i)
    thresholds_v: tuple[float, ...] = tuple(3.548 * i for i in _INDEX)
    weights_um_per_v: tuple[float, ...] = tuple(0.0383 * math.exp(-0.1206 * i) for i in _INDEX)
    offset_um: float = 0.0  # position at rest
    dac_codes: int = 65535  # codes above 0 V
    adc_codes: int = 32767  # codes on either side of zero
    sensor_range_um: float = 38.0  # reading at either end of the sensor's range
    sensor_bandwidth_hz: float = 10e3  # corner of the first-order sensor
    sensor_noise_um: float = 1e-3  # noise of each reading, rms


@kernel()
def _run(
    command: F64,  # float64[n], drive in V
    signal_um: F64,  # float64[n], filled with the sensor's signal at each reading
    drive_v: F64,  # float64[n], filled with the drive at the instant of each reading
    state: F64,  # float64[2]: drive in V, sensor output in um; updated
    plays: F64_2D,  # float64[3, m]: threshold, weight and output of each play operator; updated
    constants: tuple[float, float, float, float],
) -> None:
    """Note the sensor's signal, output the command and advance one period; for every sample."""
    # Weight of the drive, remaining part of the sensor's error after a sample period, a DAC code in
    # V, and the position at rest in um.
    slope, left, dac_code, offset = constants
    drive = state[0]
    sensor = state[1]
    for j in range(command.size):
        signal_um[j] = sensor
        drive_v[j] = drive
        drive = np.rint(command[j] / dac_code) * dac_code
        position = offset + slope * drive
        for i in range(plays.shape[1]):
            threshold = plays[0, i]
            plays[2, i] = max(drive - threshold, min(drive + threshold, plays[2, i]))
            position += plays[1, i] * plays[2, i]
        sensor = position + left * (sensor - position)
    state[0] = drive
    state[1] = sensor


class PiezoActuator(Plant):
    """The stage with its sensor; commands and drive in V."""

    def __init__(self, parameters: PiezoParameters, sample_rate_hz: float, seed: int = 1) -> None:
        """Build the stage at rest: at its offset at 0 V, never driven before."""
        range_um = parameters.sensor_range_um
        sensor = range_um / parameters.adc_codes, range_um
        super().__init__(parameters.sensor_noise_um, seed, sensor)
        thresholds = np.array(parameters.thresholds_v, dtype=np.float64)
        weights = np.array(parameters.weights_um_per_v, dtype=np.float64)
        self._plays = np.stack([thresholds, weights, np.zeros_like(weights)])
        self._constants = (
            parameters.slope_um_per_v,
            math.exp(-2.0 * math.pi * parameters.sensor_bandwidth_hz / sample_rate_hz),
            parameters.drive_max_v / parameters.dac_codes,
            parameters.offset_um,
        )
        self._state = np.zeros(2)
        self.warm_up()

    def _rest(self) -> None:
        self._state[:] = (0.0, self._constants[-1])
        self._plays[2] = 0.0

    def _advance(self, command: F64, noise_um: F64, signal_um: F64, measured: F64) -> None:
        _run(command, signal_um, measured, self._state, self._plays, self._constants)

"""Simulated piezo stage on leaf springs, with what a soft stage adds to hysteresis.

The stack is a sum of play operators of the voltage, whose displacement is s V + sum w_i z_i. Each
of these is an option of its own:

* accommodation: the plays relax towards the voltage with the distance it travels, so that the mean
  of small loops drifts in the first cycles (Bertotti, Hysteresis in Magnetism, 1998, ch. 13);
* creep: relaxations with time constants in even steps of a logarithm (H. Jung and D.-G. Gweon,
  "Creep characteristics of piezoelectric actuators", Rev. Sci. Instrum. 71 (2000) 1896);
* a guide that rubs: a bristle of some stiffness that slips at its largest deflection (P. Dahl);
* two modes close to each other.

The constants are not those of a product.
"""

import math
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.jit import ensure_compiled, kernel
from hilctl_drivers.simulated.actuator_base import CHUNK, Plant
from hilctl_drivers.simulated.structure import motion, respond


@dataclass(frozen=True, slots=True)
class LeafStageParameters:
    """Constants of stack, guide, structure, amplifier and sensor."""

    drive_min_v: float = 0.0  # bottom of the drive
    drive_max_v: float = 100.0  # top of the drive
    amplifier_bandwidth_hz: float = 3e3  # corner of the first-order amplifier
    slope_um_per_v: float = 0.2  # s
    plays_um: float = 7.0  # sum of w_i, over the drive's range
    plays: int = 40  # thresholds, up to half the range
    forgetting: float = 0.0  # part of a play's distance that it loses over the range; 0: none
    creep_percent: float = 0.0  # of a motion, per decade of time
    creep_times_s: tuple[float, ...] = (1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0)
    rubbing_um: float = 0.0  # displacement that the guide holds back at most
    bristle_um: float = 0.4  # motion to its slip
    # Natural frequency in Hz, damping ratio and share of the static displacement.
    modes: tuple[tuple[float, float, float], ...] = ((760.0, 0.03, 1.0),)
    dac_codes: int = 65535  # codes above 0 V
    adc_codes: int = 32767  # codes on either side of zero
    sensor_range_um: float = 40.0  # reading at either end of the sensor's range
    sensor_bandwidth_hz: float = 5e3  # corner of the first-order sensor
    sensor_noise_um: float = 2e-3  # noise of each reading, rms
    step_max_s: float = 2e-5  # longest internal time step

    def thresholds_v(self) -> F64:
        """Return the thresholds of the plays in V: float64[plays]."""
        half_v = 0.5 * (self.drive_max_v - self.drive_min_v)
        return (np.arange(self.plays) + 0.5) * half_v / self.plays

    def weights(self) -> F64:
        """Return the weights of the plays in um/V, which fall with the threshold."""
        threshold_v = self.thresholds_v()
        falling = 1.0 - threshold_v / threshold_v[-1] + 0.1
        moved_v = np.maximum(self.drive_max_v - self.drive_min_v - 2.0 * threshold_v, 0.0)
        return self.plays_um * falling / float(falling @ moved_v)


@kernel()
def _follow(
    command: F64,  # float64[n], drive in V
    drive_v: F64,  # float64[n], filled with the drive at the instant of each reading
    free_um: F64,  # float64[n substeps], filled with the displacement at the end of each step
    state: F64,  # float64[2], drive in V and deflection of the bristle in um; updated
    plays: F64,  # float64[m], updated
    threshold: F64,  # float64[m]
    weight: F64,  # float64[m]
    crept: F64,  # float64[k], parts of the displacement that have crept; updated
    decay: F64,  # float64[k], remaining part of their distance after a step
    constants: tuple[float, float, float, float, float, float],
    substeps: int,
) -> None:
    """Output commands and let stack, creep and guide follow."""
    left, code, slope, forgetting, share, rubbing = constants
    drive, bristle, before = state[0], state[1], state[2]
    for j in range(command.size):
        drive_v[j] = drive
        target = np.rint(command[j] / code) * code
        for k in range(j * substeps, (j + 1) * substeps):
            last = drive
            drive = target + left * (drive - target)
            lost = forgetting * abs(drive - last)
            quick = slope * drive
            for i in range(plays.size):
                z = plays[i] + lost * (drive - plays[i])
                plays[i] = min(max(z, drive - threshold[i]), drive + threshold[i])
                quick += weight[i] * plays[i]
            total = quick
            for i in range(crept.size):
                crept[i] = quick + decay[i] * (crept[i] - quick)
                total += share * (crept[i] - quick)
            # Elastic up to its slip, then sliding.
            bristle = min(max(bristle + (total - before), -state[3]), state[3])
            before = total
            free_um[k] = total - rubbing * bristle / state[3]
    state[0], state[1], state[2] = drive, bristle, before


class LeafStage(Plant):
    """The stage with its amplifier and sensor; commands and drive in V."""

    def __init__(
        self, parameters: LeafStageParameters, sample_rate_hz: float, seed: int = 1
    ) -> None:
        """Build the stage at rest after a long time at 0 V."""
        self._substeps = math.ceil(1.0 / (sample_rate_hz * parameters.step_max_s) - 1e-9)
        range_um = parameters.sensor_range_um
        sensor = range_um / parameters.adc_codes, range_um
        chunk = max(1, CHUNK // self._substeps)
        super().__init__(parameters.sensor_noise_um, seed, sensor, chunk)
        step_s = 1.0 / (sample_rate_hz * self._substeps)
        ensure_compiled(_follow, respond)
        self._threshold, self._weight = parameters.thresholds_v(), parameters.weights()
        self._decay = np.exp(-step_s / np.array(parameters.creep_times_s))
        range_v = parameters.drive_max_v - parameters.drive_min_v
        self._constants = (
            math.exp(-2.0 * math.pi * parameters.amplifier_bandwidth_hz * step_s),
            parameters.drive_max_v / parameters.dac_codes,
            parameters.slope_um_per_v,
            parameters.forgetting / range_v,
            0.01 * parameters.creep_percent,
            parameters.rubbing_um,
        )
        self._bristle_um = parameters.bristle_um
        modes = [(2.0 * math.pi * hz, damping, share) for hz, damping, share in parameters.modes]
        self._motion = motion(modes, parameters.sensor_bandwidth_hz, step_s)
        self._mechanics = np.zeros(self._motion.shape[1])
        self._plays, self._crept = np.zeros(parameters.plays), np.zeros(self._decay.size)
        self._state = np.zeros(4)
        self.warm_up()

    def _rest(self) -> None:
        self._state[:] = 0.0, 0.0, 0.0, self._bristle_um
        self._mechanics[:] = 0.0
        self._plays[:] = 0.0
        self._crept[:] = 0.0

    def _advance(self, command: F64, noise_um: F64, signal_um: F64, measured: F64) -> None:
        free_um = np.empty(command.size * self._substeps)
        _follow(
            command, measured, free_um, self._state, self._plays, self._threshold, self._weight,
            self._crept, self._decay, self._constants, self._substeps,
        )  # fmt: skip
        fixed = self._mechanics, self._motion, 0.0, self._substeps
        respond(free_um, signal_um, *fixed)

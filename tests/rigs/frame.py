"""Two Terfenol rods that carry a beam: sensors at their heads see each other through it.

Each head is pulled by its rod's stiffness and by a flexure to the beam, which springs hold. The
beam moves and turns; its centre of mass is off the middle, so both modes couple. The equations are
``M q'' + C q' + K q = F s`` for the beam and ``x = a s + b q`` for the heads, with the free
displacements ``s`` of the rods; C is proportional, so the modes of M and K are independent.
"""

import numpy as np
from scipy.linalg import eigh

from hilctl.kernels.dynamics import mode_block, mode_motion
from hilctl_drivers.simulated.crosstalk import CoupledPlants
from hilctl_drivers.simulated.devices import SimulatedTerfenol
from hilctl_drivers.simulated.simulated_device import JointSimulated, SimulatedDevice

ROD_N_PER_UM, FLEXURE_N_PER_UM = 33.6, 3.0
SPRING_N_PER_UM, TURNING_N_PER_UM = 0.5, 12.0  # of the beam, about its middle
MASS_KG, TURNING_KG, OFF_MIDDLE = 4.2, 4.4, 0.15  # inertia in kg at half the span, offset in spans
DAMPING_RATIO = 0.05


class FramedPlants(CoupledPlants):
    """Plants whose heads carry the beam."""

    def __init__(self, plants, sample_rate_hz):
        super().__init__(plants, {}, sample_rate_hz)
        ends = np.array([[1.0, 1.0], [1.0, -1.0]])  # of the beam, by translation and turn
        held = FLEXURE_N_PER_UM / (ROD_N_PER_UM + FLEXURE_N_PER_UM)
        self._direct, self._through = 1.0 - held, held * ends
        mass = np.array([[MASS_KG, MASS_KG * OFF_MIDDLE], [MASS_KG * OFF_MIDDLE, TURNING_KG]])
        stiffness = np.diag([SPRING_N_PER_UM, TURNING_N_PER_UM])
        stiffness += FLEXURE_N_PER_UM * (1.0 - held) * ends.T @ ends
        squares, shapes = eigh(stiffness * 1e6, mass)
        natural = np.sqrt(squares)
        self.natural_hz = natural / (2.0 * np.pi)
        force = FLEXURE_N_PER_UM * (1.0 - held) * ends.T
        self._into = shapes.T @ force * 1e6 / squares[:, None]  # static share of each mode
        self._out_of = self._through @ shapes
        self._modes = [
            (np.array([*mode_motion(hz, DAMPING_RATIO, sample_rate_hz).ravel(), 1.0, 0, 0, 0]),
             np.zeros(3)) for hz in self.natural_hz
        ]  # fmt: skip

    def seen(self, own_um):
        """Return the displacements of the heads."""
        own = np.array(own_um)
        moved = np.empty_like(own)
        for pushed, into, (parameters, memory) in zip(
            self._into @ own, moved, self._modes, strict=True
        ):
            mode_block(pushed, parameters, memory, into)
        return [*(self._direct * own + self._out_of @ moved)]


class JointFramed(JointSimulated):
    """Both rods and the beam."""

    def coupled(self, plants, sample_rate_hz):
        """Return the rods with the beam."""
        return FramedPlants(plants, sample_rate_hz)


class SimulatedFramed(SimulatedTerfenol):
    """One of two rods; alone, it carries nothing."""

    def join(self, devices):
        """Return both rods with the beam."""
        rods = {name: each for name, each in devices.items() if isinstance(each, SimulatedDevice)}
        return JointFramed(rods)

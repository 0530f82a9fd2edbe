"""The rigs as devices: ``simulated_terfenol`` with other rods, and another piezo stack."""

from typing import ClassVar

from hilctl.base.strict import Field
from hilctl_drivers.simulated.devices import SimulatedTerfenol, TerfenolOptions
from hilctl_drivers.simulated.pinned_cells import PinnedCellsParameters
from hilctl_drivers.simulated.simulated_device import SimulatedDevice, SimulatedOptions
from tests.rigs.anisotropic_rod import AnisotropicRod, AnisotropicRodParameters
from tests.rigs.diffusion import DiffusionParameters
from tests.rigs.domains import DomainsParameters
from tests.rigs.jiles_atherton import GrowingLagParameters, JilesAthertonParameters
from tests.rigs.leaf_stage import LeafStage, LeafStageParameters
from tests.rigs.relaxor import Relaxor, RelaxorParameters
from tests.rigs.thermal_switching import SwitchingActuator, SwitchingParameters

RODS = {
    "pinned_cells": PinnedCellsParameters,
    "domains": DomainsParameters,
    "diffusion": DiffusionParameters,
    "jiles_atherton": JilesAthertonParameters,
    "growing_lag": GrowingLagParameters,
}


class DomainsOptions(TerfenolOptions):
    RODS: ClassVar = DomainsParameters


class DiffusionOptions(TerfenolOptions):
    RODS: ClassVar = DiffusionParameters


class JilesAthertonOptions(TerfenolOptions):
    RODS: ClassVar = JilesAthertonParameters


class GrowingLagOptions(TerfenolOptions):
    RODS: ClassVar = GrowingLagParameters


OTHER_RODS = (DomainsOptions, DiffusionOptions, JilesAthertonOptions, GrowingLagOptions)


class SimulatedDomains(SimulatedTerfenol):
    """Domains of eight orientations, averaged over their energies."""

    Options: ClassVar = DomainsOptions


class SimulatedDiffusion(SimulatedTerfenol):
    """The field diffuses into conducting rods, shell by shell."""

    Options: ClassVar = DiffusionOptions


class SimulatedJilesAtherton(SimulatedTerfenol):
    """Jiles and Atherton's equations with eddy and excess loss."""

    Options: ClassVar = JilesAthertonOptions


class SimulatedGrowingLag(SimulatedTerfenol):
    """The same with an eddy-current loss that grows with itself."""

    Options: ClassVar = GrowingLagOptions


class SimulatedStack(SimulatedDevice):
    """A device around ``_parameters`` of a stack with a capacitive sensor; commands in V."""

    def __init__(self, options, name, description):
        super().__init__(
            options,
            self._parameters,
            name=f"simulated_{name}",
            description=f"{description}, and capacitive sensor",
            command_unit="V",
            command_min=self._parameters.drive_min_v,
            command_max=self._parameters.drive_max_v,
            command_step=self._parameters.drive_max_v / self._parameters.dac_codes,
        )


class SwitchingOptions(SimulatedOptions):
    sensor_noise_um: float = Field(default=1e-3, ge=0.0, le=1.0, description="rms noise, um")


class SimulatedThermalSwitching(SimulatedStack):
    """A piezo stack whose domains switch over barriers by thermal activation; commands in V."""

    Options: ClassVar = SwitchingOptions

    def __init__(self, options):
        self._seed = options.seed
        noise_um = options.sensor_noise_um if options.noise else 0.0
        self._parameters = SwitchingParameters(sensor_noise_um=noise_um)
        super().__init__(
            options, "thermal_switching", "simulated piezo stack with thermal activation"
        )

    def plant(self, sample_rate_hz):
        """Return the stack at rest."""
        return SwitchingActuator(self._parameters, sample_rate_hz, self._seed)


class LeafStageOptions(SimulatedOptions):
    forgetting: float = Field(default=0.0, ge=0.0, description="see LeafStageParameters")
    creep_percent: float = Field(default=0.0, ge=0.0, description="likewise, % per decade")
    rubbing_um: float = Field(default=0.0, ge=0.0, description="likewise, um")
    bristle_um: float = Field(default=0.4, gt=0.0, description="likewise, um")
    modes: tuple[tuple[float, float, float], ...] = Field(
        default=((760.0, 0.03, 1.0),), description="Hz, damping ratio and share"
    )


class SimulatedLeafStage(SimulatedStack):
    """A piezo stage on leaf springs with accommodation, creep, friction and modes."""

    Options: ClassVar = LeafStageOptions

    def __init__(self, options):
        self._seed = options.seed
        keys = ("forgetting", "creep_percent", "rubbing_um", "bristle_um", "modes")
        self._parameters = LeafStageParameters(
            **{key: getattr(options, key) for key in keys},
            sensor_noise_um=2e-3 if options.noise else 0.0,
        )
        super().__init__(options, "leaf_stage", "simulated piezo stage on leaf springs")

    def plant(self, sample_rate_hz):
        """Return the stage at rest."""
        return LeafStage(self._parameters, sample_rate_hz, self._seed)


class DrawnOptions(SimulatedOptions):
    draw: int = Field(default=0, ge=0, description="seed of the constants; 0: nominal ones")


class SimulatedRelaxor(SimulatedStack):
    """An electrostrictive stack whose polarisation relaxes over many decades."""

    Options: ClassVar = DrawnOptions

    def __init__(self, options):
        self._seed = options.seed
        noise_um = 2e-3 if options.noise else 0.0
        self._parameters = RelaxorParameters(sensor_noise_um=noise_um).drawn(options.draw)
        super().__init__(options, "relaxor", "simulated electrostrictive stack")

    def plant(self, sample_rate_hz):
        """Return the stack at rest."""
        return Relaxor(self._parameters, sample_rate_hz, self._seed)


class SimulatedAnisotropicRod(SimulatedDevice):
    """A rod under prestress that saturates and gets stiffer; commands in A."""

    Options: ClassVar = DrawnOptions

    def __init__(self, options):
        self._seed = options.seed
        noise_um = 0.02 if options.noise else 0.0
        nominal = AnisotropicRodParameters(sensor_noise_um=noise_um)
        self._parameters = nominal.drawn(options.draw)
        super().__init__(
            options,
            self._parameters,
            name="simulated_anisotropic_rod",
            description="simulated rod under prestress, linear amplifier and capacitive sensor",
            command_unit="A",
            command_min=-self._parameters.dac_range_a,
            command_max=self._parameters.dac_range_a,
            command_step=self._parameters.dac_range_a / self._parameters.dac_codes,
        )

    def plant(self, sample_rate_hz):
        """Return the rod at rest."""
        return AnisotropicRod(self._parameters, sample_rate_hz, self._seed)

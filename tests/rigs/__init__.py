"""Simulated rigs of other physics than the product's; no model has their structure.

Models and drivers are tested on them, and ``tests/benchmark`` judges models on them. They are
devices of another package: :func:`register` makes their names known.
"""

from hilctl.experiment.devices import BUILTIN

ROD_LENGTH_M = 0.1206  # two rods of 60.3 mm, section 3.3.1 (chapter 2) of the dissertation
ROD_RADIUS_M = 6.15e-3
VACUUM_PERMEABILITY = 1.25663706212e-6

DEVICES = {
    "simulated_domains": "tests.rigs.devices:SimulatedDomains",
    "simulated_diffusion": "tests.rigs.devices:SimulatedDiffusion",
    "simulated_jiles_atherton": "tests.rigs.devices:SimulatedJilesAtherton",
    "simulated_growing_lag": "tests.rigs.devices:SimulatedGrowingLag",
    "simulated_thermal_switching": "tests.rigs.devices:SimulatedThermalSwitching",
    "simulated_leaf_stage": "tests.rigs.devices:SimulatedLeafStage",
    "simulated_anisotropic_rod": "tests.rigs.devices:SimulatedAnisotropicRod",
    "simulated_relaxor": "tests.rigs.devices:SimulatedRelaxor",
    "simulated_framed": "tests.rigs.frame:SimulatedFramed",
}


def register():
    """Make the devices known to experiments of this process."""
    BUILTIN.update(DEVICES)

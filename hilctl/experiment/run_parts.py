"""What of a checked experiment its loop is made from."""

from typing import Protocol

from hilctl.base.device import Device
from hilctl.experiment.file import Experiment
from hilctl.models.base import HysteresisModel


class RunParts(Protocol):
    """The parts that are executed: of a loaded experiment, or as the loop's process gets them."""

    @property
    def config(self) -> Experiment:
        """The experiment, checked."""
        ...

    @property
    def device(self) -> Device:
        """Its device, not opened."""
        ...

    @property
    def model(self) -> HysteresisModel | None:
        """The compensator's model; None where nothing compensates."""
        ...

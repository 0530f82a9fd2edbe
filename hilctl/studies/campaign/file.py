"""The campaign file: frozen, strict models of the YAML."""

from typing import Annotated, Any, Literal

from pydantic import Field

from hilctl.base.strict import StrictModel
from hilctl.experiment.sections import Condition, Name

RunOrder = Literal["as_written", "random", "alternating"]


class ReferenceRun(StrictModel):
    """The same run again and again: its change is the drift of rig and actuator.

    Attributes:
        every: It comes first, after so many steps, and last.
        set: Keys of the base experiment that it has otherwise.
    """

    every: Annotated[int, Field(ge=1, le=10_000)]
    set: dict[str, Any] = Field(default_factory=dict)


class CoolDown(StrictModel):
    """How long the coil cools before a run, by its own thermal model in ``limits``.

    Attributes:
        to_rms_a: Running rms of the current that it cools to before every run; left out, only as
            far as the run needs to keep its budget.
    """

    to_rms_a: Annotated[float, Field(gt=0.0)] | None = None


class CampaignFile(StrictModel):
    """One campaign: a base experiment, and what varies.

    Attributes:
        name: Short name; that of its recordings, and of their folder.
        description: What it is for.
        experiment: The base experiment's file, relative to this file's folder.
        set: Keys of it that all steps have otherwise; dotted, as with ``--set``.
        vary: Dotted keys, each with a list of values, or with a range ``first:last:count`` of
            even steps, ``first:last:countlog`` of even ratios. The keys of a mapping are crossed;
            in a list of mappings, the keys of each go together and the mappings are crossed.
        order: ``as_written``, the last key fastest; ``random`` by ``seed``; or ``alternating`` up
            and down, against drift.
        seed: Of the random order.
        repeat: How often each step is run.
        reference_run: A run that comes again and again; None for none.
        condition: What the actuator goes through before every run.
        cool_down: How long the coil cools before a run.
        folder: Where recordings and table go, relative to where hilctl runs; left out, a folder of
            the campaign's name in the experiment's ``recording.folder``.
    """

    name: Name
    description: str = ""
    experiment: str
    set: dict[str, Any] = Field(default_factory=dict)
    vary: dict[str, Any] | tuple[dict[str, Any], ...]
    order: RunOrder = "as_written"
    seed: Annotated[int, Field(ge=0)] = 1
    repeat: Annotated[int, Field(ge=1, le=10_000)] = 1
    reference_run: ReferenceRun | None = None
    condition: Condition | None = None
    cool_down: CoolDown = Field(default_factory=CoolDown)
    folder: str | None = None

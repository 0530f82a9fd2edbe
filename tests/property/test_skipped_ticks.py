"""One tick late by 1 to 20 periods, every kind of model: what is put out is what was due."""

import numpy as np
import pytest

from hilctl.base.samples import Flag
from hilctl.loop.limiter import CommandLimits
from hilctl.models.model_file import load_model
from hilctl.models.staged import StagedModel
from tests.fakes import FakeClock
from tests.unit.loop.test_loop import CONFIGS, RATE_HZ, Rig
from tests.unit.models.literature.test_implicit_models import BOUC_WEN, DUHEM, KP, PREISACH
from tests.unit.models.test_base import MODELS as PLAYS
from tests.unit.models.test_generalised_duhem import duhem_model

COMPARED = {"preisach": PREISACH, "kp": KP, "bouc_wen": BOUC_WEN, "duhem": DUHEM}
SHIPPED = {path.stem: load_model(path) for path in sorted(CONFIGS.glob("*.yaml"))}
TABLED = {"generalised_duhem": StagedModel.around(duhem_model())}
KINDS = PLAYS | COMPARED | TABLED | SHIPPED
WIDE = CommandLimits(low=-200.0, high=200.0, slew_per_s=2e5, safe=0.0, ramp_per_s=2e4)
FREE = {"limits": WIDE, "stroke_um": (-1e4, 1e4)}


@pytest.mark.slow
@pytest.mark.parametrize("frequency_hz", [1.0, 50.0, 250.0])
@pytest.mark.parametrize("kind", KINDS)
def test_command_after_skipped_ticks_is_the_one_that_was_due(kind, frequency_hz):
    """Within 1 % of the command's stroke, and flagged; what comes before it is not."""
    model = KINDS[kind]
    reference = 4.0 * np.sin(2 * np.pi * frequency_hz / RATE_HZ * np.arange(200) + 0.3)
    plain = Rig(reference, model=model, **FREE)
    assert plain.run().code == "completed"
    due = plain.host.column(2)[:200]
    for late in (1, 2, 5, 10, 20):
        clock = FakeClock(stall_ns={60: late * 1_000_000})
        rig = Rig(reference, model=model, clock=clock, **FREE)
        assert rig.run().code == "completed"
        at = rig.firsts.index(60 + late)
        came = rig.host.column(2)[at : 200 - late]
        assert np.abs(came - due[60 + late :]).max() <= 0.01 * np.ptp(due)
        assert rig.host.flags[at][0] & Flag.AFTER_SKIPPED
        assert not any(flags[0] & Flag.AFTER_SKIPPED for flags in rig.host.flags[:at])

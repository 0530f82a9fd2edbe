"""Composed ticks and the others: the same bytes, whatever happens in the run."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.loop.compensator import Compensator
from hilctl.loop.composed import compose
from hilctl.loop.conditioning import Conditioning
from hilctl.loop.feedback import Feedback, Gains
from hilctl.loop.host import StraightLine, Tuning
from hilctl.loop.integral import IntegralFeedback
from hilctl.loop.interlocks import InterlockContext, Interlocks, InterlockSettings
from hilctl.loop.limiter import CommandLimits, Limiter
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import LateRules
from hilctl.loop.plan import Plan
from hilctl.models.base import Operator
from hilctl.models.bouc_wen import BoucWenModel
from hilctl.models.chain import Chain
from hilctl.models.creep import Creep
from hilctl.models.files import load_model
from hilctl.models.spi import SpiModel
from hilctl.models.staged import FieldLag, StagedModel
from hilctl.models.structure import Mode, Structure
from tests.fakes import FakeClock, FakeDevice, FakeFifoDevice, FakeHost, made_block
from tests.published import piezo_ppi, terfenol_rdpi

RATE_HZ = 1000.0
LIMITS = CommandLimits(low=-5.0, high=5.0, slew_per_s=2000.0, safe=0.0, ramp_per_s=100.0)
SHIPPED = Path("configs/models")
LAG = FieldLag(tau_s=2e-4, growth_per_unit=0.05)
STRUCTURE = Structure(natural_hz=300.0, damping_ratio=0.1)
MODE = Mode(
    natural_hz=120.0, damping_ratio=0.05, antiresonance_hz=110.0, antiresonance_damping_ratio=0.05
)
CREEP = Creep(time_constants_s=(0.1, 1.0), shares=(0.02, 0.02))
PPI = piezo_ppi().model_copy(update={"input_unit": "A", "output_offset_um": 0.25})
MODELS = {
    "none": None,
    "ppi": PPI,
    "spi": SpiModel(**PPI.model_dump(exclude={"kind"})),
    "rdpi": terfenol_rdpi(),
    "omega": load_model(SHIPPED / "terfenol_omega.yaml"),
    "bouc_wen": BoucWenModel(
        command_span=(-5.0, 5.0), direct=8.0, hysteretic=1.0, beta=1.0, gamma=0.5
    ),
    "staged": StagedModel.around(terfenol_rdpi(), lag=LAG, structure=STRUCTURE, delay_s=1.3e-3),
    "ringing": StagedModel.around(terfenol_rdpi(), structure=STRUCTURE, modes=(MODE,), creep=CREEP),
    "preisach": load_model(SHIPPED / "terfenol_staged_preisach.yaml"),
}


def plan(model="rdpi", *, block=1, latency=0, n=84, **options):
    reference = 14.0 * np.sin(2 * np.pi * 25.0 * np.arange(n) / RATE_HZ)
    compensator = Compensator(MODELS[model], RATE_HZ)
    compensator.warm_up()
    given = {
        "input_um": compensator.ahead(reference) if MODELS[model] else reference,
        "limits": LIMITS,
        "interlocks": InterlockContext(stroke_um=(-60.0, 60.0), frozen_travel=1.0),
        "late_rules": LateRules(late_after_ns=5e5),
        "keep_all": False,
    }
    return Plan(
        reference=reference,
        block=block,
        latency_blocks=latency,
        sample_rate_hz=RATE_HZ,
        compensator=compensator,
        **(given | options),
    )


def run(made, *, latency=0, stalls=None, tunings=None, full=range(0), begin_at=0.0, **device):
    """Run a plan; return the loop, and all that the host has of the run, as plain values."""
    clock = FakeClock(stall_ns=stalls or {})
    size = made.compensator.state_size + 1
    host = FakeHost(clock, made.block, size, tunings=dict(tunings or {}), full=full)
    driven = FakeFifoDevice(latency, **device) if latency else FakeDevice(**device)
    loop = Loop(made, driven, host)
    loop.begin_at(begin_at)
    outcome = loop.run(1_000_000)
    arrays = [np.array(each).tobytes() for each in (host.columns, host.flags, host.states)]
    return outcome, [repr(event) for event in host.events], host.heads, host.sent, arrays


def both(monkeypatch, make, **options):
    """Run the same plan by composed ticks and without; return what the runs were."""
    composed = run(make(), **options)
    monkeypatch.setattr("hilctl.loop.loop.compose", lambda *_: None)
    return composed, run(make(), **options)


@pytest.mark.parametrize("block", [1, 7])
@pytest.mark.parametrize("model", MODELS)
def test_every_model_gives_the_same_bytes(monkeypatch, model, block):
    """Commands, states, flags, events: whole blocks, and the last one that the ramp begins in."""
    composed, plain = both(monkeypatch, lambda: plan(model, block=block, n=81))
    assert composed == plain
    assert composed[0].code == "completed"


STALLS = {9: 2_500_000, 30: 9_000_000}
HELD = InterlockSettings(
    rms_current_a=30.0, thermal_time_constant_s=0.2, tracking_error_um=80.0, tracking_s=0.01
)
CASES = {
    "skipped ticks": ({"interlock_settings": HELD}, {"stalls": STALLS}),
    "trip": ({"interlocks": InterlockContext(stroke_um=(-12.0, 12.0))}, {}),
    "too hot": (
        {"interlock_settings": InterlockSettings(rms_current_a=1.0, thermal_time_constant_s=0.02)},
        {"stalls": STALLS},
    ),
    "limits": ({"limits": CommandLimits(-1.0, 1.0, 150.0, 0.0, 100.0)}, {}),
    "no sensor": ({}, {"nan_at": 40}),
    "no answer": ({}, {"break_at": 40}),
    "no room": ({}, {"full": range(20, 24)}),
    "a ramp before": ({}, {"begin_at": 1.0}),
    "conditioning": (
        {
            "conditioning": Conditioning(
                np.zeros(28), rest=(7, 21), cycle_samples=0, stands_um=0.5, lead_in=10
            )
        },
        {},
    ),
    "invalid": ({"input_um": np.where(np.arange(84) == 43, np.nan, 1.0)}, {}),
    "tuned and back": (
        {},
        {
            "tunings": {
                14: Tuning(0.5, 1.0, 5, inverse_share=0.0, line=StraightLine(0.1, 0.0)),
                42: Tuning(1.0, 0.0, 5),
            }
        },
    ),
}


@pytest.mark.parametrize("block", [1, 7])
@pytest.mark.parametrize("name", CASES)
def test_whatever_happens_the_bytes_are_the_same(monkeypatch, name, block):
    """Ticks that are composed and ticks that are not follow one another without a seam."""
    options, around = CASES[name]
    composed, plain = both(monkeypatch, lambda: plan(block=block, **options), **around)
    assert composed == plain


@pytest.mark.parametrize("stalls", [{}, STALLS])
def test_answers_that_come_later(monkeypatch, stalls):
    """Through a FIFO each block is judged by the answers that belong to it, late or not."""
    policy = {"late_policy": "follow", "ramp_policy": "follow"}
    composed, plain = both(
        monkeypatch,
        lambda: plan(block=7, latency=3, **policy),
        latency=3,
        begin_at=1.0,
        stalls=stalls,
    )
    assert composed == plain


@pytest.mark.parametrize("kind", ["each sample", "blocks"])
def test_feedback(monkeypatch, kind):
    """What a controller adds to the input passes the composed compensator."""

    def make():
        if kind == "blocks":
            return plan(block=7, feedback=IntegralFeedback(0.2, 2.0, 1, 2))
        return plan(feedback=Feedback(Gains(0.1, 20.0), RATE_HZ, 2.0, 1))

    composed, plain = both(monkeypatch, make, stalls=STALLS)
    assert composed == plain


def composed_of(made):
    limiter = Limiter(made.limits, 1.0 / RATE_HZ)
    return compose(made, limiter, Interlocks(made.interlocks, made.interlock_settings, RATE_HZ))


def test_usual_ticks_are_composed(monkeypatch):
    """Else all the comparisons here are of one thing with itself."""
    made, seen = plan("staged", n=40), []
    host = FakeHost(FakeClock(), 1, made.compensator.state_size + 1)
    answered = host.answered
    monkeypatch.setattr(host, "answered", lambda block: seen.append(block) or answered(block))
    Loop(made, FakeDevice(), host).run(0)
    assert [block.composed for block in seen[:40]] == [True] * 40
    assert not any(block.composed for block in seen[40:])


class Tripled:
    """Stands for a model whose inverse is a function of Python's."""

    def inverse(self, _rate_hz):
        return Operator(lambda block, _memory, out: np.multiply(block, 3.0, out=out), 0)


def test_what_is_more_than_stages_is_not_composed(monkeypatch):
    """The loop runs it as it always did, in a chain with stages too."""
    monkeypatch.setitem(MODELS, "other", Tripled())
    assert composed_of(plan("other")) is None
    assert Chain([Tripled().inverse(RATE_HZ), terfenol_rdpi().inverse(RATE_HZ)]).stages() is None


def test_blocks_of_another_shape_are_refused():
    """What is called by its address must not reach beyond it."""
    composed = composed_of(plan("none"))
    with pytest.raises(ValueError, match="do not fit"):
        composed.plan_block(made_block(2), 0)
    with pytest.raises(ValueError, match="do not fit"):
        composed.follow_block(made_block(1, state_size=2))


def test_an_input_that_is_not_in_one_piece_is_not_composed():
    """Every second sample of an array has no address of its own."""
    assert composed_of(plan("none", input_um=np.zeros(168)[::2])) is None

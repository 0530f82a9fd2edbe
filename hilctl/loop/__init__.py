"""The fixed-rate loop: everything that a tick executes; no file, no log, no other thread.

loop.py         one tick from top to bottom, and the phases of a run
plan.py         the plan of a run, and the host that a loop runs in
lead_in.py      initial ramp, conditioning cycle, and the offset at rest
block.py        a block of samples in its slot
pacer.py        absolute deadlines, and the policies for late ticks
tuning.py       smooth changes of gain, offset and the inverse's share
compensator.py  the inverse of a model
feedback.py     controllers around the compensator
adaptation.py   adaptation of the model by the tracking error
triggers.py     digital output at marks of the waveform, start by a digital input
limiter.py      range and slew of every command
interlocks.py   conditions that end a run, checked in every answer
safe_output.py  writes of the safe value, and the outcome of a run
"""

PUBLIC = (
    "adaptation", "block", "compensator", "feedback", "interlocks", "lead_in", "limiter", "loop",
    "pacer", "plan", "safe_output", "triggers", "tuning",
)  # fmt: skip
"""Modules that other rooms import; the others are private."""

"""Everything that a tick executes; no file, no log, no other thread.

loop.py         block after block until the waveform ends, or something goes wrong
plan.py         what a run does, whom the loop answers to, how a run ended
pacer.py        absolute deadlines and the policy for late ticks
tuning.py       gain and offset of a running reference
compensator.py  the inverse of a model, in the loop's terms
feedback.py     a controller around the compensator
limiter.py      range and slew of every command: last before the device
in_flight.py    blocks that were sent and have no answer yet
interlocks.py   what ends a run, looked at in every answer
"""

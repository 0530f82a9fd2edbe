"""Everything that a tick executes; no file, no log, no other thread.

loop.py         block after block until the waveform ends, or something goes wrong
plan.py         what a run does, and how it ended
beginning.py    what comes before the waveform: ramp, and conditioning.py with the resting offset
host.py         what the loop needs of its host: time, room for blocks, supervision
feed.py         what the compensator is fed with
block.py        one block of samples, in its slot from birth to answer
pacer.py        absolute deadlines and the policy for late ticks
tuning.py       gain and offset of a running reference, and the inverse faded out and in
compensator.py  the inverse of a model, in the loop's terms
feedback.py     a controller around the compensator, per sample or per block
adaptation.py   offset, gain and weights of the model, adapted by the tracking error
limiter.py      range and slew of every command: last before the device
interlocks.py   what ends a run, checked in every answer
"""

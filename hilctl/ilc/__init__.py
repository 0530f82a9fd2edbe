"""Learning on references that repeat: the error of one run corrects the input of the next.

cycle.py       pure: the error of the steady cycles of a recording, harmonic by harmonic, with noise
response.py    pure: how the displacement answers a change of the correction (delay, resonance)
update.py      pure: from errors so far to the next correction; bandwidth, guard and stop
results.py     what each run said, and what came of it
session.py     runs, one after the other
"""

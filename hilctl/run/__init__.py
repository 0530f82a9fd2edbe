"""The processes around one loop: start, shared memory, recording, requests, recovery.

start.py         from an experiment file to a finished run; runs that are steps of a study
supervisor.py    starts loop, guardian and recorder, and monitors the run to its end
processes.py     loop and guardian as child processes
loop_process.py  the loop process, and its side of the shared memory
job.py           the job that loop and guardian read, as JSON in the run's folder
assemble.py      from a checked experiment to the plan of the loop
unpaced.py       a run of a simulated device without real time
recorder.py      from the ring into the recording, in a thread
metadata.py      metadata of a recording, figures of its end, the description for watchers
run_folder.py    folders of runs, and locks of devices
recovery.py      recordings of dead runs
probe.py         whether a device answers plausibly
result.py        progress and result of a run
shared/          ring of sample blocks, and the page of numbers, texts and events
safety/          the safe value if the loop cannot set it: guardian, supervisor, hilctl safe
control/         requests to a supervisor: client, socket, validation, changes
"""

PUBLIC = (
    "assemble", "control.client", "metadata", "probe", "recovery", "result",
    "run_folder", "safety.manual_safe", "shared.ring", "shared.shared_page", "start", "unpaced",
)  # fmt: skip
"""Modules that other rooms import; the others are private."""

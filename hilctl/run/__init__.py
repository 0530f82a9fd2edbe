"""Three processes round one loop: shared memory, recording, requests, recovery.

start.py           from an experiment file to a finished run; runs that are steps of several
architecture.py    systems that a run may be on
job.py             what loop and guardian get, as JSON text in the run's folder
supervisor.py      starts loop, guardian and recorder, and watches the run to its end
child.py           the supervisor's hold on its processes
loop_process.py    the loop process, and its side of the shared memory
assemble.py        from a checked experiment and an open device to the plan of the loop
guardian.py        a process that sets the safe value if the loop dies or hangs;
                   guardian_process.py  starts it, safety.py  watches and replaces it
ring.py            sample blocks in shared memory, behind shared_page.py
recorder.py        from the ring into the recording, in a thread
metadata.py        facts and figures of a run, for its recording and for watchers
run_folder.py      active runs, and who holds a device
requests.py        requests to a run, over control_socket.py; stopping.py  a signal to stop;
                   client.py  sends them, protocol.py  has their words; detached.py  starts runs in
                   the background
changes.py         gain, offset and inverse on their way to the loop
own_process.py     a run of a program with threads, in a process of its own
probe.py           whether a device answers, and whether that can be true
orphans.py         what dead runs left behind; dead_runs.py  finished before anything is read
by_hand.py         a device set to its safe value without a run
unpaced.py         a run of a simulated device without real time
result.py          progress and result of a run
"""

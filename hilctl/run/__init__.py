"""Three processes round one loop: shared memory, recording, requests, recovery.

start.py           from an experiment file to a finished run
step.py            one run of several, and by what its recording is known
architecture.py    systems that a run may be on
job.py             what loop and guardian get, as JSON text in the run's folder
assemble.py        from a checked experiment to the plan of its loop
supervisor.py      starts loop, guardian and recorder; started_run.py  sees to them to the end
child.py           the supervisor's hold on its processes; hang_watch.py  whether it hangs
guardian.py        a process that makes the output safe where the loop can't, started by
                   guardian_process.py; safety.py  sees to it, and stands in for it;
                   safe_action.py  what both do then
loop_process.py    the loop process; host.py  its side of the shared memory
starting.py        where the output is before a run
ring.py            sample blocks in shared memory, behind shared_page.py
recorder.py        into the recording; metadata.py what it says of the run, end_figures.py of
                   what came out
ring_recorder.py   from the ring into it, in a thread of its own; progress.py  for who looks on
run_folder.py      runs that are going on, and who holds a device
description.py     what a run says of itself to those who look on
requests.py        requests to a run, over control_socket.py; stopping.py a signal to stop;
                   client.py sends them, protocol.py has their words; detached.py starts runs in
                   the background
changes.py         gain, offset and inverse on their way to the loop
systemd.py         readiness and watchdog of a service
probe.py           whether a device answers, and whether that can be true
orphans.py         what dead runs left behind; dead_runs.py  finished before anything is read
by_hand.py         a device put at its safe value with no run
unpaced.py         a run of a simulated device that needs no real time
result.py          where a run stands, and how it ended
"""

"""Two processes round one loop: shared memory, recording, requests, recovery.

start.py           from an experiment file to a finished run
architecture.py    processors that a run may be on
job.py             the experiment as it goes to the loop's process
assemble.py        from a checked experiment to the plan of its loop
supervisor.py      starts the loop's process, records, makes the rig safe
child.py           the supervisor's hold on that process; hang_watch.py  whether it hangs
loop_process.py    the loop's process; host.py  its side of the shared memory
ring.py            sample blocks in shared memory, behind shared_page.py
recorder.py        into the recording; metadata.py what it says of the run
run_folder.py      runs that are going on, and who holds a device
requests.py        requests to a run, over control_socket.py; stopping.py a signal to stop;
                   client.py sends them, detached.py starts runs in the background
changes.py         gain and offset on their way to the loop; change_worker.py works them out
systemd.py         readiness and watchdog of a service
orphans.py         what dead runs left behind
unpaced.py         a run of a simulated device that needs no real time
result.py          where a run stands, and how it ended
"""

"""Real-time set-up and diagnosis of this computer.

rt_setup.py       real-time settings and set-up of the loop process; syscalls.py  its system calls
procfs.py         /proc, /sys and /dev of a machine; resources used by this process
timer_latency.py  wake-up lateness, measured in a separate process with the loop's pacer
diagnosis.py      checks, each with a remedy; the verdict, and metadata for a recording
"""

PUBLIC = ("diagnosis", "procfs", "rt_setup", "syscalls", "timer_latency")
"""Modules that other rooms import; the others are private."""

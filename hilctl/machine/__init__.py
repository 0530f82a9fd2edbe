"""Real-time set-up and diagnosis of this computer.

rt_setup.py       real-time settings and set-up of the loop process; syscalls.py  its system calls
procfs.py         /proc, /sys and /dev of a machine; resources used by this process
checks.py         one function per check, each with a remedy
timer_latency.py  wake-up lateness, measured in a separate process with the loop's pacer
diagnosis.py      all checks, the verdict, and metadata for a recording
"""

PUBLIC = ("checks", "diagnosis", "procfs", "rt_setup", "syscalls", "timer_latency")
"""Modules that other rooms import; the others are private."""

"""What this computer can do: real-time set-up, and what stands in its way.

settings.py   how the loop's process asks for real time
realtime.py   asks for it, step by step; linux.py  the system calls,
files.py      what is read of a machine: its /proc and /sys, or those of a test
usage.py      what a process has taken of it
findings.py   one function a check: good, worth knowing, or bad, with the remedy
logind.py     what a log-out does to a run in the background
hardware.py   the same for serial ports, CPUs and disks
latency.py    wake-up lateness, measured with the loop's pacer in a process of its own
diagnosis.py  all findings, the verdict, and the facts for a recording
"""

"""Whether this machine can keep time, and what to change where it can't.

machine.py   what is read of a machine: its /proc and /sys, or those of a test
findings.py  one function a check: good, worth knowing, or bad, with the remedy
hardware.py  the same for serial ports, CPUs and disks
latency.py   wake-up lateness, measured with the loop's pacer in a process of its own
diagnosis.py all findings, the verdict, and the facts for a recording
report.py    the same for people
"""

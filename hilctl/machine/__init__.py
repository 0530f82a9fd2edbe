"""Real-time set-up and diagnosis of this computer."""

PUBLIC = ("diagnosis", "procfs", "reserve", "rt_setup", "suspend", "syscalls", "timer_latency")
"""Modules that other packages import; the others are private."""

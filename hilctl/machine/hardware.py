"""CPUs, clocks, serial ports and disks: one function a check."""

from pathlib import Path

from hilctl.machine.procfs import Finding, Machine

_CPU = "/sys/devices/system/cpu"
_SERIAL = ("/dev/ttyUSB*", "/dev/ttyACM*")
_SERIAL_DAEMONS = ("ModemManager", "brltty")
_LATENCY_TIMERS = "/sys/bus/usb-serial/devices/*/latency_timer"
_LONG_LATENCY_MS = 1
_LITTLE_SPACE_BYTES = 1 << 30
_STEADY_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock")


def governor(machine: Machine) -> Finding:
    """Whether the CPU's clock stays up between ticks."""
    names = {machine.text(path) for path in machine.glob(f"{_CPU}/cpu*/cpufreq/scaling_governor")}
    governors = sorted(filter(None, names))
    if not governors:
        return Finding("CPU governor", "ok", "none: the frequency is not the kernel's to change")
    text = ", ".join(governors)
    if governors == ["performance"]:
        return Finding("CPU governor", "ok", text)
    return Finding("CPU governor", "warn", text, "cpupower frequency-set --governor performance")


def hyperthreads(machine: Machine) -> Finding:
    """Whether two threads share a core, so that one slows the other down."""
    if machine.text(f"{_CPU}/smt/active") == "1":
        remedy = (
            "isolate both threads of a core, or: echo off > /sys/devices/system/cpu/smt/control"
        )
        return Finding("SMT", "warn", "on: two threads share a core", remedy)
    return Finding("SMT", "ok", "off")


def virtual_machine(machine: Machine) -> Finding:
    """Whether the machine is one of several on the same hardware."""
    flags = machine.text("/proc/cpuinfo") or ""
    product = machine.text("/sys/class/dmi/id/product_name")
    kind = machine.text("/sys/hypervisor/type") or product or "a hypervisor"
    if "hypervisor" in flags.split():
        remedy = "drive real actuators from a machine of their own"
        return Finding("hardware", "warn", f"virtual ({kind}): the host can stall it", remedy)
    return Finding("hardware", "ok", product or "not virtual")


def clock_source(machine: Machine) -> Finding:
    """Whether reading the time is quick."""
    folder = "/sys/devices/system/clocksource/clocksource0"
    source = machine.text(f"{folder}/current_clocksource") or "unknown"
    if source in _STEADY_CLOCKS:
        return Finding("clock source", "ok", source)
    have = machine.text(f"{folder}/available_clocksource") or ""
    remedy = "boot with tsc=reliable" if "tsc" in have.split() else ""
    return Finding("clock source", "warn", f"{source}: each look at the time is slow", remedy)


def latency_timers(machine: Machine) -> Finding:
    """Whether FTDI adapters pass bytes on at once; by default they wait for up to 16 ms."""
    slow = []
    paths = machine.glob(_LATENCY_TIMERS)
    for path in paths:
        timer_ms = machine.number(path)
        if timer_ms is None or timer_ms > _LONG_LATENCY_MS:
            slow.append(f"{Path(path).parent.name} {timer_ms} ms")
    if slow:
        remedy = (
            'a udev rule: ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", '
            'ATTR{latency_timer}="1"'
        )
        return Finding("FTDI latency", "bad", ", ".join(slow), remedy)
    return Finding("FTDI latency", "ok", "1 ms" if paths else "no FTDI adapter")


def serial_ports(machine: Machine) -> Finding:
    """Whether this user may open the serial ports that are plugged in."""
    ports = [port for pattern in _SERIAL for port in machine.glob(pattern)]
    closed = [port for port in ports if not machine.writable(machine.path(port))]
    if closed:
        group = _group_of(machine.path(closed[0]))
        remedy = f"sudo usermod --append --groups {group} $USER, and log in anew"
        return Finding("serial ports", "bad", f"no permission for {', '.join(closed)}", remedy)
    return Finding("serial ports", "ok", ", ".join(ports) or "none plugged in")


def serial_daemons(machine: Machine) -> Finding:
    """Whether daemons run that open serial ports by themselves."""
    running = {machine.text(path) for path in machine.glob("/proc/[0-9]*/comm")}
    active = [name for name in _SERIAL_DAEMONS if name in running]
    if not active:
        return Finding("serial daemons", "ok", "none active")
    verb = "read and write" if len(active) > 1 else "reads and writes"
    text = f"{' and '.join(active)} {verb} serial ports that are plugged in"
    remedy = f"sudo systemctl disable --now {' '.join(active)}"
    return Finding("serial daemons", "warn", text, remedy)


def _group_of(path: Path) -> str:
    import grp

    try:
        return grp.getgrgid(path.stat().st_gid).gr_name
    except (KeyError, OSError):
        return "dialout"


def disk_space(machine: Machine, folder: Path) -> Finding:
    """Whether there is room for recordings.

    Args:
        machine: The machine.
        folder: Where recordings go; it need not exist yet.
    """
    try:
        place = folder.absolute()
    except FileNotFoundError:
        said = f"{folder}: the working folder has been deleted"
        return Finding("recordings", "bad", said, "change to another one")
    while not place.exists():
        place = place.parent
    free = machine.free_bytes(place)
    text = f"{free / 1e9:.1f} GB free for {folder}"
    if free < _LITTLE_SPACE_BYTES:
        remedy = "make room, or set recording.folder to another disk"
        return Finding("recordings", "bad", text, remedy)
    return Finding("recordings", "ok", text)

"""Settings of systemd-logind: whether a background run outlives the log-out of its user."""

import os

from hilctl.machine.procfs import Finding, Machine

_FOLDERS = ("/usr/lib/systemd", "/usr/local/lib/systemd", "/run/systemd", "/etc/systemd")
"""Folders of settings, the one that counts most last."""
_SYSTEM_USERS = 999
_NO = {"no", "n", "false", "f", "off", "0"}


def log_out(machine: Machine) -> Finding:
    """Return what systemd-logind does to a run when its user logs out."""
    name = "log-out"
    user = int((machine.status("Uid") or str(os.geteuid())).split()[0])
    if not machine.path("/run/systemd/system").is_dir():
        return Finding(name, "ok", "no systemd: a log-out removes nothing")
    settings = _settings(machine)
    if settings.get("KillUserProcesses", "no").lower() not in _NO:
        text = "ends all processes of a user, background runs too (KillUserProcesses=yes)"
        remedy = "put KillUserProcesses=no into /etc/systemd/logind.conf, or run as a service"
        return Finding(name, "warn", text, remedy)
    if settings.get("RemoveIPC", "yes").lower() in _NO:
        return Finding(name, "ok", "removes nothing (RemoveIPC=no)")
    if user <= _SYSTEM_USERS:
        return Finding(name, "ok", "removes nothing of a system user")
    import pwd  # Windows, on which offline commands import this module, has none

    try:
        login = pwd.getpwuid(user).pw_name
    except KeyError:
        login = str(user)
    if machine.path(f"/var/lib/systemd/linger/{login}").exists():
        return Finding(name, "ok", "removes nothing while the user lingers")
    text = "removes a user's files in /dev/shm, those of active runs too (RemoveIPC=yes)"
    return Finding(name, "warn", text, f"sudo loginctl enable-linger {login}")


def _settings(machine: Machine) -> dict[str, str]:
    main = ""
    parts: dict[str, str] = {}
    for folder in _FOLDERS:
        main = machine.text(f"{folder}/logind.conf") or main
        for path in machine.glob(f"{folder}/logind.conf.d/*.conf"):
            parts[path.rsplit("/", 1)[1]] = machine.text(path) or ""
    found = {}
    for text in (main, *(parts[name] for name in sorted(parts))):
        for line in text.splitlines():
            key, equals, value = line.partition("=")
            if equals and not line.lstrip().startswith(("#", ";")):
                found[key.strip()] = value.strip()
    return found

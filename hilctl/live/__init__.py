"""The live views of a run: web page, Foxglove server and frames for programs.

A live view is not part of a run: it maps the run's ring read-only and sends changes to the run's
control socket. Killing it does not affect the run.
"""

PUBLIC = ("run_reader", "server_process")
"""Modules that other packages import; the others are private."""

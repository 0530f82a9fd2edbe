"""The live views of a run: web page, Foxglove server and frames for programs.

A live view is not part of a run: it maps the run's ring read-only and sends changes to the run's
control socket. Killing it does not affect the run.

run_reader.py    reader of one run's folder; its frames; list of active runs
scope.py         signals that are shown; time windows and hysteresis loops; minimum and maximum
                 per bucket of samples
live_metrics.py  running metrics, use of each limit
server.py        the page on loopback, with authentication; session of one page
foxglove.py      server for Foxglove and compatible applications
server_process.py  server processes
"""

PUBLIC = ("run_reader", "scope", "server_process")
"""Modules that other rooms import; the others are private."""

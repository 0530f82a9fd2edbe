"""The live views of a run: web page, Foxglove server and frames for programs.

A live view is not part of a run: it maps the run's ring read-only and sends changes to the run's
control socket. Killing it does not affect the run.

signals.py    the columns that are shown
scope.py      time windows, rolling or triggered by the waveform's cycle, and hysteresis loops;
              minimum and maximum of each signal per bucket of samples
figures.py    running metrics; headroom.py  use of each limit
feed.py       reader of one run's folder, with error spectrum and lateness
frames.py     frames for a page and for programs; foxglove_topics.py  for Foxglove
feeds.py      the active runs
server.py     the page, its files and its connections, on loopback
admission.py  authentication; viewer.py  session of one page: requests and rate limit
foxglove_server.py  server for Foxglove and compatible applications
live.py       server processes
"""

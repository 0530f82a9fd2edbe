"""Who looks on: the live page of a running experiment, its server, and the frames behind it.

Nothing here is part of a run: it maps the run's ring so that it can't write to it, and asks for
changes by the run's own control socket. Kill it at any time, and the run does not notice.

signals.py    the columns that are shown
scope.py      windows over time, rolling or triggered to the waveform's cycle, and its loops;
              lowest and highest of each signal in buckets of samples: no spike is lost
figures.py    running figures of quality; headroom.py  what is left to each limit
feed.py       all of it from one run's folder, with error spectrum and lateness
frames.py     as bytes for a page and as arrays for programs; foxglove_topics.py  for Foxglove
feeds.py      the runs that are going on
server.py     the page, its files and its connections, on loopback
admission.py  who is let in; viewer.py  one page: what it asks for, and how much it gets
foxglove_server.py  the same without a page, for Foxglove and its like
live.py       the servers as processes
"""

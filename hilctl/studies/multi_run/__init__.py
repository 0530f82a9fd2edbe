"""Many runs side by side: what varied among them, what came out, figures and one page.

Nothing is run here. The runs are those of a campaign, by its table and recordings, or recordings
that somebody names.

run_figures.py   what a recording says of its run, as one row of a table; drift of reference runs
minor_loops.py   pure: the minor loops of an average cycle
ringing.py       pure: natural frequency and damping of a step's ringing
digest.py        what one run gives to figures of many: loop, error and response, some kilobytes
columns.py       names of a campaign's table; written and read
collect.py       runs of a folder or of files, each read once
dimension.py     pure: what varied, and in which words
trend.py         pure: a figure against what varied, with linear fit and direction
headline.py      what came out, in a line or two
sheets.py        selection of figures, figures as files, step and frequency responses;
                 loop_sheets.py, trend_sheets.py draw the others
look.py          how runs are told apart in figures
page.py          one page of many runs, and the same for programs
"""

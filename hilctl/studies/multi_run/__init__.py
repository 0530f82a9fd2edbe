"""Reports of many runs: of a campaign, a folder, or named recordings.

collect.py           runs of a campaign's table, a folder, or files
digest.py            metrics of one run, and its data for figures
minor_loops.py       minor loops of an average cycle
ringdown.py          natural frequency and damping after a step
varied_parameter.py  varied keys with names and units
trend.py             metrics against varied parameters; headline
run_plots.py         figures of runs side by side
plots.py             figures of trends; selection and files of all figures
multi_run_page.py    HTML page and JSON
"""

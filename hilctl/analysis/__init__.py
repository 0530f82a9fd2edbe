"""What a recording says: figures of merit, tables, plots and a page.

timing.py   lateness percentiles, late ticks; quantiles.py  percentiles in bounded memory
processes.py  memory and processor time of the run's processes
steady.py   which part of a recording is judged, and its average cycle
figures.py  what a report holds
report.py   from a recording, whole or in pieces, to a report; segment_figures.py  those of one
            segment; overview.py  what plots need of a recording of any length
table.py    a report for people, as rows of text
canvas.py   what all plots share: style, colours, signals over time
sheet.py    a figure before its size is known; vector.py  figures as files, and as SVG of a page
plots.py    plots over time and frequency: history, error and its spectrum, lateness
loops.py    the hysteresis loop, and before and after
html.py     parts of self-contained pages, and definitions of their figures
run_page.py the page of a run; provenance.py  when, by whom and with what it was made
replay.py   the same commands again; predicted.py  the error of another model
export.py   samples as a table; export_files.py  CSV, Parquet, NPZ, MAT; export_all.py  all
            recordings of a folder as one data set
catalogue.py  the recordings in a folder, what is known of each, and conditions on them
"""

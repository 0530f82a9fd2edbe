"""What models are fitted to.

records.py  steady loops and whole time histories
thin.py     long histories with fewer samples
cycles.py   loops from recordings and from histories that repeat
period.py   the period of a command, and where it is steady
files.py    recordings and tables in
"""

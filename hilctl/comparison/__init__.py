"""Models of the literature on the same loops, identified, judged and tried alike.

compare.py  all of it together; identified models as files
trials.py   each inverse before a simulated device, in this process; time a sample
summary.py  the table's texts
page.py     table and figure as one page
"""

"""Comparison of hysteresis models on the same loops.

compare.py           identify, evaluate and try models; the table as text; model files
simulated_trials.py  each inverse on a simulated device, and its time per sample
comparison_page.py   table and figure as an HTML page
"""

PUBLIC = ("compare", "comparison_page")
"""Modules that other rooms import; the others are private."""

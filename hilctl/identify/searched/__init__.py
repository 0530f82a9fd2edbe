"""Fits whose thresholds are searched from several starts.

search.py      least squares from several starts; refinement for the peak error
plays.py       PPI, SPI and RDPI as a search problem
integrated.py  the integrated model with exponential weights as a search problem
butterfly.py   plays and an even function, for actuators without a bias
"""

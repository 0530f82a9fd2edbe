"""Fits of the models of the literature beside the integrated one.

operators.py     non-negative least squares: Preisach, Krasnosel'skii-Pokrovskii, a straight line
asymmetric.py    the rate-independent integrated model
envelopes.py     the generalised Prandtl-Ishlinskii model
differential.py  Bouc-Wen and Duhem
"""

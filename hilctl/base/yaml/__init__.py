"""YAML as hilctl reads it: the plain part, strictly.

plain.py     what of YAML is read, and what a scalar is
document.py  a file with the line of every value; settings over it; validation
messages.py  broken rules in words
"""

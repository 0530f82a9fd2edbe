"""YAML as hilctl reads and writes it: the plain part of YAML 1.2, strictly.

plain.py     what of YAML is read, what a scalar is, and plain data as YAML
messages.py  broken rules in words; lenient.py  what is read although it stands otherwise
commented.py  plain data with comments, for people
document.py  a file with the line of every value; settings over it; validation
"""

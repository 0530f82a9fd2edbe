"""YAML as hilctl reads and writes it: the plain part of YAML 1.2, strictly.

io.py      files and texts with the line of every value; settings over them; plain data as YAML
errors.py  broken rules in words, and what is read although YAML has it otherwise
"""

from hilctl.base.yaml.errors import Loc, broken_rules, did_you_mean, dotted, loc_of
from hilctl.base.yaml.io import Document, commented, dump, load_document

__all__ = [
    "Document", "Loc", "broken_rules", "commented", "did_you_mean", "dotted", "dump",
    "load_document", "loc_of",
]  # fmt: skip

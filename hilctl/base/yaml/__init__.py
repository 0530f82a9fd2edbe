"""Strict subset of YAML 1.2.

io.py      documents with the line of every value; settings; plain data as YAML
errors.py  validation errors in words
"""

from hilctl.base.yaml.errors import Loc, broken_rules, dotted, loc_of
from hilctl.base.yaml.io import Document, commented, dump, load_document, option_file

__all__ = [
    "Document", "Loc", "broken_rules", "commented", "dotted", "dump",
    "load_document", "loc_of", "option_file",
]  # fmt: skip

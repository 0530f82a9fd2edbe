"""The identify command.

request.py  what was asked for
finding.py  settings together, progress shown, the model written and judged
console.py  the result in tables
page.py     the result as a page with figures
"""

from hilctl.finding.console import print_finding
from hilctl.finding.finding import Finding, find
from hilctl.finding.request import Request

__all__ = ["Finding", "Request", "find", "print_finding"]

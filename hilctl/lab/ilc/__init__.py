"""Iterative learning control: the error of one run corrects the input of the next."""

PUBLIC = ("cycle", "residual", "update")
"""Modules that other packages import; the others are private."""

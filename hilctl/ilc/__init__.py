"""Iterative learning control: the error of one run corrects the input of the next."""

"""Better models from recordings of their use.

remainder.py  what a model leaves of the displacement, as one linear problem
strength.py   how firmly the old model is held to, by runs left out in turn
command.py    from files to a better model, or to why there is none
page.py       what was found, in lines and as a page
"""

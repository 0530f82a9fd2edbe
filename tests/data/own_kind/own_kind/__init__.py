"""A gain with backlash, as a kind of model."""

"""A device of one's own for hilctl, as an example."""

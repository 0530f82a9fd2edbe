"""The safe value if the loop cannot set it: guardian, supervisor, or ``hilctl safe``."""

"""Better models from recordings of their use."""

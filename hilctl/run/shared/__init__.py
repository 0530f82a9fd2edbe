"""Memory shared by loop, supervisor, guardian and watchers."""

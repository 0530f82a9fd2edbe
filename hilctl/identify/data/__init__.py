"""Records that models are fitted to: loops and histories, from recordings and tables."""

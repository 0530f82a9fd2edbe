"""Models of the literature compared: identified, evaluated and tried on the same loops."""

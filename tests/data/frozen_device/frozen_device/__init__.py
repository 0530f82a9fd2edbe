"""A device written for hilctl 0.2.0."""

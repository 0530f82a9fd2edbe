"""Campaigns: runs of one experiment over a grid of parameters."""

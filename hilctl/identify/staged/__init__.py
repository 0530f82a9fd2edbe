"""Fits of free weights and stages: what is linear needs no search."""

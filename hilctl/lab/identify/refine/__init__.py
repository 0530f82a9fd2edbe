"""Refinement of models by recordings of their use."""

"""Requests to a running supervisor: socket, validation and client."""

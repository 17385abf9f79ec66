"""Logs of whole rovers as a problem of inference."""

"""Fits, evidence and tests for any model with parameters: names no rover, joint, port or channel."""

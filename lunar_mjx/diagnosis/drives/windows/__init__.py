"""Drives with imposed wheel speeds, judged in short windows that begin at what was measured."""

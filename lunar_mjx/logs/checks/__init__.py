"""Checks of measurement logs, before anything is fitted to them."""

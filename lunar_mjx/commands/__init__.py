"""The commands of `lunar-mjx`, a module for each topic."""

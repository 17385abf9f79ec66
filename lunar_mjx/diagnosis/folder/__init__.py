"""The files of a run folder, as they are read back."""

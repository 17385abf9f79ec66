"""Unknown inputs at the ports: where a model fails, before anything is named."""

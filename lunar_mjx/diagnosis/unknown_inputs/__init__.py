"""Unknown inputs at the ports: what nobody modelled, and how large it usually is."""

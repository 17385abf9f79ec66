"""Formulas that might be missing at a port, searched where no effect of the catalogue is."""

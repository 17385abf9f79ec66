"""Problems whose hypotheses are weighed by one search, whatever was measured: from probabilities to an answer."""

"""Inference that knows nothing of rovers: evidence of hypotheses that share a discrepancy, and the search over them."""

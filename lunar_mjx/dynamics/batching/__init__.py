"""Many rovers at once: the batch axis, and what is computed once for many kernels."""

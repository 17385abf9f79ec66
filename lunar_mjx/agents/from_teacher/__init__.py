"""Policies that learn from a policy which sees more."""

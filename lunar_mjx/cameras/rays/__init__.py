"""Rays against ground, rocks and rovers: where they hit, and what they hit there."""

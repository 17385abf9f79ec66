"""Worlds that share no law, no code and no noise model with lunar-mjx: a bench for criticism of models that are wrong.

Everything that makes data here stands on NumPy, SciPy and plain MuJoCo; `work.py` alone calls the tool, by its own
verbs. The command line is `python -m benchmarks.foreign`.
"""

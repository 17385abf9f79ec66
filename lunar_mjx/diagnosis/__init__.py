"""Run folders, and the verbs that work on them: compare, why, add, improve, next experiment, audit, report."""

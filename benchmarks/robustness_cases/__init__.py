"""The cases of benchmarks/robustness.py."""

NOTHING = "nothing to compare with"  # what a case says that could not be tried here

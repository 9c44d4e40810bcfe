"""The cases of benchmarks/robustness.py."""

"""Logged trajectories of a real plant: files, smoothing, simulation errors, where the log has been."""

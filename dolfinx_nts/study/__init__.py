"""Runs of runs: speed against accuracy, and the price of each feature."""

"""Runs: the time loop, load steps, adaptive steps, what a run has to say."""

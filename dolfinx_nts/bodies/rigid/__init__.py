"""Rigid bodies: inertia, prescribed motion and loads."""

"""Slender bodies: beams and shells, nodes of a place and directors."""

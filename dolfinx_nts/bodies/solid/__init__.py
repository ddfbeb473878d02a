"""Solid bodies, with forms in UFL: continua, their materials, mass and stress."""

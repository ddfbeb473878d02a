"""Meshes of bodies: read, checked, and made of others."""

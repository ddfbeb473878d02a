"""Bodies: what a scene asks of them, continua, their materials and meshes, their points."""

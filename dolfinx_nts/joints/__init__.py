"""What couples bodies beside contact: springs and dampers."""

"""What is scanned: towns and other meshes, places in them, and the simulated sensor with its effects."""

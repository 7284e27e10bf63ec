"""One object out of a frame or a scene: planes, clusters and masks."""

"""What is drawn in the scene and taken hold of."""

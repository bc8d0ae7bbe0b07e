"""What the surroundings of a point look like, and which points of two clouds look alike."""

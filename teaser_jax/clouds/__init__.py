"""Raw clouds: from points as a sensor or a modeller gives them to matches, and from a pose to its support."""

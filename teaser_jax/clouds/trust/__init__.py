"""Whether a pose between two clouds deserves trust: what fits, what holds it, and what else would fit."""

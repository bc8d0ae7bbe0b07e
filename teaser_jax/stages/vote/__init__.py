"""One unknown number from many measurements of it: exact truncated least squares (section VII)."""

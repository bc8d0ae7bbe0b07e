"""The largest set of matches that agree pairwise (section VI-D): a method a file, each with its record."""

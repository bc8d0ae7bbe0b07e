"""Several answers to one set of matches: where they start, what speaks for them, which of them differ."""

"""The stages of the method: a chapter of the paper each, in the order in which the data meets them."""

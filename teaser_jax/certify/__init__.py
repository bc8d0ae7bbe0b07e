"""The proof and nothing else: how far a rotation can be from the best one there is (section VIII-C)."""

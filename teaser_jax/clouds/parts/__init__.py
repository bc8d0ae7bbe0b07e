"""Small parts, of which a scan shows one side: found by a search, not by matches."""

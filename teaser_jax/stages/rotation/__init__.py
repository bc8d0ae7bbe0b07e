"""The robust rotation (12): what it is estimated from, and a method a file, each with its record."""

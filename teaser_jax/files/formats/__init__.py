"""One reader for each kind of file. ``files.clouds`` chooses among them."""

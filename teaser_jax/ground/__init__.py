"""What every other room stands on: arrays, packed bits, checks of arguments, loops, files."""

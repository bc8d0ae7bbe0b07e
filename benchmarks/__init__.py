"""What the library is worth, measured: ``python -m benchmarks [--only NAME ...] [--quick]``."""

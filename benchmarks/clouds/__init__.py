"""Benchmarks of raw clouds: a table beside other libraries, and an evaluator for the public sets."""

from benchmarks.clouds.table import metrics, report, run

__all__ = ["metrics", "report", "run"]

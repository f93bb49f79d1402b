"""Measurements: `python -m benchmarks` for speed, `python -m benchmarks.adaptation` for what adaptation achieves."""

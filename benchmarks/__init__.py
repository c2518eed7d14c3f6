"""Measure the suite and its peers on the same work; results land in benchmarks/results."""

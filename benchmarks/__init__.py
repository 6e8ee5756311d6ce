"""Timings, each against a rival of the same work in the same run."""

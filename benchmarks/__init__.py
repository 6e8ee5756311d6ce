"""Timings of the library and of competitors that do the same work in the same run."""

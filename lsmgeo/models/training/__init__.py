"""Training that loses no work."""

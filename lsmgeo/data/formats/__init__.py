"""One file a format: what it holds is read, checked and given as one typed scene."""

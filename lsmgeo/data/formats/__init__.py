"""Readers, one file for each format: all return one typed scene; `detection.FORMATS` lists them."""

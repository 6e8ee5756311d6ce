"""The tests of lsmgeo."""

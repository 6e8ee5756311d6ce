"""Fault injection: the library broken in named ways, and the laws that notice.

``python -m tests.mutants`` prints which laws notice which fault.
"""

"""Damaged files against every reader: a short run in the tests (test_fuzz.py), a long one by `python -m tests.fuzz
minutes=60`."""

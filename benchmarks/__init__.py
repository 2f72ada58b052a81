"""Measurements that anyone can rerun: each module prints a table and one JSON line with the ratio that matters."""

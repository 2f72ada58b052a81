"""Find, name, model and prove what the simulator left out of a recorded mechanism: `diagnose.py`."""

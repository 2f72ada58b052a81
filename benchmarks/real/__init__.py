"""Real recordings, made by others, converted to the recording format and diagnosed: `python -m benchmarks.real`."""

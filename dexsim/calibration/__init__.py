"""Calibration of a hand's currents and taxel counts: fits from press recordings, and the file that deployment reads."""

"""What a hand's currents and taxel counts mean: fits from press recordings, and the file that deployment reads."""

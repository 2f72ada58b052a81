"""Step 1: recordings in, their signals tested, runs of plain arrays out."""

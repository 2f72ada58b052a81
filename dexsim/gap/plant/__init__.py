"""Step 3: one joint as a small system of its own, simulated in batches under many parameter guesses."""

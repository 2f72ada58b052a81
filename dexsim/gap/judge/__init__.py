"""Step 5: held-out errors, confidence, findings and the verdict."""

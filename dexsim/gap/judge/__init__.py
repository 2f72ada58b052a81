"""Step 5: what is held out, errors on it, confidence, findings, the verdict, and what is handed on to training."""

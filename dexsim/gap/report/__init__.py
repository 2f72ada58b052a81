"""Step 6: the page, the files, what to record next."""

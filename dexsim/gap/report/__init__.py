"""Step 6: the page, the files, the sentence, what to record next."""

"""Step 4: which effects a joint has: scan, fit, select on conditions left out."""

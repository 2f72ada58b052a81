"""dexsim beside what else one could use, in one run on one machine: only ratios are meant to be quoted."""

"""Touch through the same steps (`gap.steps`) as the drives: taxels and contact, pad by pad."""

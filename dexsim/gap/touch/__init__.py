"""Touch through the same steps (`gap.inquiry`) as the drives: taxels and contact, pad by pad."""

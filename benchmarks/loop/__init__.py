"""The loop closed: a policy loses in a concealed reality, is recorded there, diagnosed, fine-tuned with what was found,
and run again."""

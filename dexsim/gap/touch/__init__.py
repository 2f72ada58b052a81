"""The same steps for touch: taxels and contact."""

"""The catalogue: what each effect is, what it is confused with, how it is fitted and handed on."""

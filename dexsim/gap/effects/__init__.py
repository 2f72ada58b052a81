"""The catalogue, a file for each family of effects: what each is, what it is confused with, how it is fitted and handed
on."""

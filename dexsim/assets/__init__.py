"""Hand and object models that ship with dexsim."""

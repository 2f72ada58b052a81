"""A second fake of the vendor's package, made from the published facts alone and sharing nothing with dexsim."""

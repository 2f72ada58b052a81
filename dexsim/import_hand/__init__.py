"""A robot's own file (URDF, MJCF) as a hand's folder: `dexsim import-hand`.

`source` reads it, `tree` finds palm, fingers and tips, `frame` guesses which way they close and the palm's frame,
`figures` checks masses, limits and efforts, `shapes` makes collision shapes, `poses` searches an open and a cupped
pose, `taxels` paints touch pads, `build` writes the model, `folder` the folder, `picture` and `moves` show it. What a
person corrected in hand.yaml (`corrections`) goes before every guess.
"""
